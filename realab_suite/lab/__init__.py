"""Designs under test: learners, experiments, verdicts, audits, attribution."""

"""Evaluation: ledgers, metrics, statistics; alone in reading true rewards."""

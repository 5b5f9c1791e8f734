"""Audits: searches for an exploit of a design in a world, without training."""

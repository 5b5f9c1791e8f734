"""Designs, feedback providers and the mechanism that runs them in a world."""

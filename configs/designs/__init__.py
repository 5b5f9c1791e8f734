"""Data only: the agent designs that `suite.load(..., design=name)` finds."""

"""Data only: the agent designs for `suite.load(..., design=name)`."""

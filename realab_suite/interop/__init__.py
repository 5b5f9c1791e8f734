"""Doors for programs that are no part of this package."""

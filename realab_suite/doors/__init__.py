"""Interfaces for programs outside this package."""

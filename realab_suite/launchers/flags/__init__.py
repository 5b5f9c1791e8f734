"""Flags shared by several programs."""

"""Entities of worlds; each one works in any Composer task."""

"""The engine: stepping, episodes, observations and snapshots of worlds."""

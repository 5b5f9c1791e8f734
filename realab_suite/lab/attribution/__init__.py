"""Who moved it: corruption by its movers."""

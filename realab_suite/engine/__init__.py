"""How a composed world is stepped."""

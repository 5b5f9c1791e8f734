"""The agent designer's side: designs, feedback providers, the mechanism."""

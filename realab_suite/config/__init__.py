"""Configuration files: reading, validation, registries and messages."""

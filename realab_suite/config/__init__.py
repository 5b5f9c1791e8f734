"""Configuration files: reading, validation, registries and messages.

The package contains nothing about designs or experiments.
"""

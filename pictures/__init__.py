"""Pictures of the README and the docs: `python -m pictures.make`."""

"""Data only: trained agents, of `examples/train_policies.py`."""

"""Data only: networks of supervisors, of `examples/train_network.py`."""

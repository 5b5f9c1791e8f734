"""Data only: networks of supervisors, trained by `launchers.make_networks`."""

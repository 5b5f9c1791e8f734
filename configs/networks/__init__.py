"""Data only: the networks that supervisors run, made by `make_networks`."""

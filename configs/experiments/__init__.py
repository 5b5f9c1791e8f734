"""Data only: the experiments for `launchers.sweep --experiment=name`."""

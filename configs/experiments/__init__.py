"""Data only: the experiments that `launchers.train --experiment=name` finds."""

"""Data only: the experiments that `experiments.run --experiment=name` finds."""

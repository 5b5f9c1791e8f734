"""Experiments: specs, jobs, training, sweeps and scripted comparisons.

Programs with flags are in `launchers`.
"""

"""The flag that sets the seed."""

from absl import flags

LARGEST_SEED = 2**31 - 1
"""Largest seed on a command line; experiment files have the same limit."""

SEED = flags.DEFINE_integer(
    'seed',
    0,
    'Seed of everything random.',
    lower_bound=0,
    upper_bound=LARGEST_SEED,
)

"""Flag `--seed`, shared by several programs."""

from absl import flags

LARGEST_SEED = 2**31 - 1
"""Largest seed on a command line; experiment files have the same limit."""

SEED = flags.DEFINE_integer(
    'seed',
    0,
    'Seed of all random streams.',
    lower_bound=0,
    upper_bound=LARGEST_SEED,
)

"""The flag that says how many episodes, which several programs have."""

from absl import flags

EPISODES = flags.DEFINE_integer(
    'episodes',
    2,
    'How many episodes; of each seed, where there are several.',
    lower_bound=1,
    upper_bound=1_000_000,
)

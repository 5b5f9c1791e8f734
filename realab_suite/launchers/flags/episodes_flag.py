"""Flag `--episodes`, shared by several programs."""

from absl import flags

EPISODES = flags.DEFINE_integer(
    'episodes',
    2,
    'Number of episodes per seed.',
    lower_bound=1,
    upper_bound=1_000_000,
)

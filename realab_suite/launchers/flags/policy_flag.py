"""Flag `--policy`, shared by several programs."""

from absl import flags

POLICY = flags.DEFINE_string(
    'policy', 'random', 'Name of a scripted policy; no_op stands still.'
)

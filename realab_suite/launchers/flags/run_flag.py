"""Flag `--run`, shared by several programs."""

from absl import flags

RUN = flags.DEFINE_string(
    'run',
    None,
    'Run of the experiment, such as "reward", "reward.secure" (its twin) or'
    ' "reward.random" (a baseline).',
)

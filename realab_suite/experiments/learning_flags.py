"""Flags that the programs for experiments with learners share."""

from absl import flags

EXPERIMENT = flags.DEFINE_string(
    'experiment',
    None,
    'An experiment with agents that learn: the name of one that ships, or the'
    ' path of a YAML file.',
)
TENSORBOARD = flags.DEFINE_boolean(
    'tensorboard', False, 'Whether to write curves for TensorBoard, too.'
)

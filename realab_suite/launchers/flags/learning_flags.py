"""Flags that the programs for experiments with learners share."""

from absl import flags

EXPERIMENT = flags.DEFINE_string(
    'experiment',
    None,
    'An experiment with agents that learn: the name of one that ships, or the'
    ' path of a YAML file.',
)
OTHER_MACHINE = flags.DEFINE_boolean(
    'other_machine',
    False,
    'Whether to continue runs that were begun on another machine, or with other'
    ' settings of the numerical libraries. Their results then depend on both,'
    ' which done.json records.',
)
TENSORBOARD = flags.DEFINE_boolean(
    'tensorboard', False, 'Whether to write curves for TensorBoard, too.'
)

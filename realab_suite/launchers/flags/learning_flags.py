"""Flags shared by the programs that train learners."""

from absl import flags

EXPERIMENT = flags.DEFINE_string(
    'experiment',
    None,
    'Name of an experiment that is part of the package, or path of a YAML'
    ' file.',
)
TENSORBOARD = flags.DEFINE_boolean(
    'tensorboard', False, 'Also writes learning curves for TensorBoard.'
)

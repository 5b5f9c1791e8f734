"""Flags shared by the programs that train learners."""

from absl import flags

EXPERIMENT = flags.DEFINE_string(
    'experiment',
    None,
    'Name of an experiment that is part of the package, or path of a YAML'
    ' file.',
)
OTHER_MACHINE = flags.DEFINE_boolean(
    'other_machine',
    False,
    'Continues runs that were started on another machine, or with other'
    ' settings of the numerical libraries. Their results then depend on both;'
    ' done.json records this.',
)
TENSORBOARD = flags.DEFINE_boolean(
    'tensorboard', False, 'Also writes learning curves for TensorBoard.'
)

"""The flag that says where results go, which several programs have."""

from absl import flags

OUTPUT = flags.DEFINE_string(
    'output',
    None,
    'The folder to write into; a report goes to the folder of its sweep by'
    ' default.',
)

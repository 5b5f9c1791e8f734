"""Flag `--output`, shared by several programs."""

from absl import flags

OUTPUT = flags.DEFINE_string(
    'output',
    None,
    'Folder to write into. The default of a report is the folder of its'
    ' sweep.',
)

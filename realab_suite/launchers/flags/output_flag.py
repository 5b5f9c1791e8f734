"""Flag `--output`, shared by several programs."""

from absl import flags

OUTPUT = flags.DEFINE_string(
    'output',
    None,
    'Folder to write into; required, except by `report`, whose default is the'
    ' folder of the sweep. For `pack`, a .zip file.',
)

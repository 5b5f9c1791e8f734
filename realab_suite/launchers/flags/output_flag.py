"""Flag `--output`, shared by several programs."""

from absl import flags

OUTPUT = flags.DEFINE_string(
    'output',
    None,
    'Folder to write into. Default of `report`: the folder of the sweep.',
)

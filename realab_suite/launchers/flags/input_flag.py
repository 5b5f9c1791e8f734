"""Flag `--input`, shared by several programs."""

from absl import flags

INPUT = flags.DEFINE_string(
    'input',
    None,
    'Folder of a sweep: the --output folder of that program. For `unpack`, the'
    ' file that `pack` wrote.',
)

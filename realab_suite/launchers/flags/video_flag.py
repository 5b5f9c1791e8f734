"""Flag `--video`, shared by several programs."""

from absl import flags

VIDEO = flags.DEFINE_string(
    'video',
    None,
    'New film to write: an .mp4 file, or a .webp file, an animated picture.'
    ' Without it, `explore` opens a window.',
)

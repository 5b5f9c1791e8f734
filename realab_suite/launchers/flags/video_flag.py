"""Flag `--video`, shared by several programs."""

from absl import flags

VIDEO = flags.DEFINE_string(
    'video',
    None,
    'New .mp4 file to write. Without it, `explore` opens a window.',
)

"""Benchmarks of speed, relative to raw MuJoCo in the same run."""

import os

# Most benchmarks do not render; dm_control selects a renderer at import.
os.environ.setdefault('MUJOCO_GL', 'disable')

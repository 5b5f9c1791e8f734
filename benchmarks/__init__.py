"""How fast things are, measured against the raw engine in the same run."""

import os

# Nothing here renders, and dm_control looks for a renderer when imported.
os.environ.setdefault('MUJOCO_GL', 'disable')

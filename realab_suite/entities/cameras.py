"""What a camera sees, drawn when somebody asks for it."""

import functools

from dm_control import mjcf
import numpy as np

from realab_suite.entities import protocols


@functools.singledispatch
def render(
    physics: protocols.Physics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  """Draws what a camera sees; an engine may register a faster way.

  Args:
    physics: One world, or many where an engine draws them.
    camera: Through which to look.
    height: Of the frame, pixels.
    width: Of the frame, pixels.

  Returns:
    `(..., height, width, 3)` uint8, the caller's own.
  """
  raise NotImplementedError(f'no camera draws a {type(physics).__name__}')


@render.register
def _(
    physics: mjcf.Physics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  return physics.render(height, width, camera_id=camera.full_identifier)

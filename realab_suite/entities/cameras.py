"""What a camera sees, drawn when somebody asks for it."""

import functools
from typing import Any

from dm_control import mjcf
import numpy as np


@functools.singledispatch
def render(
    physics: Any, camera: mjcf.Element, height: int, width: int
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
  return physics.render(height, width, camera_id=camera.full_identifier)

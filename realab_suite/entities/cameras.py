"""Rendering of camera images."""

import functools
import typing
from typing import Any

from dm_control import _render
from dm_control import mjcf
import numpy as np

from realab_suite import _display
from realab_suite import errors
from realab_suite.entities import protocols


@functools.singledispatch
def render(
    physics: protocols.Physics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  """Renders the image of a camera.

  Engines may register faster implementations for their own physics.

  Args:
    physics: One world, or a batch of worlds if the engine supports it.
    camera: Camera to render.
    height: Height of the image, in pixels.
    width: Width of the image, in pixels.

  Returns:
    New array, `(..., height, width, 3)` uint8.

  Raises:
    NotImplementedError: If the engine cannot render.
    RenderingError: If no renderer is available.
  """
  raise NotImplementedError(f'{type(physics).__name__} cannot be rendered')


@render.register
def _(
    physics: mjcf.Physics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  try:
    _ = typing.cast(Any, physics).contexts
  except errors.RenderingError:
    raise
  except Exception as error:  # Each renderer has its own errors.
    advice = _display.what_to_set(_render.BACKEND, error)
    raise errors.RenderingError(f'camera: no frame with {advice}') from error
  return physics.render(height, width, camera_id=camera.full_identifier)

"""Pictures of a world for the page of a person, as JPEG."""

import io
from typing import Any, final

import numpy as np
from PIL import Image

from realab_suite.engine import environment
from realab_suite.engine import frame_renderer

_QUALITY = 80


@final
class View:
  """View of one camera."""

  def __init__(
      self, env: environment.Environment, camera: str, height: int, width: int
  ) -> None:
    """Initializes the view. Only the present thread can use it.

    Args:
      env: Environment with a task of this package.
      camera: Full identifier of the camera.
      height: Height of a picture, in pixels.
      width: Width of a picture, in pixels.

    Raises:
      RenderingError: If no renderer is available.
    """
    self._physics = env.thin_physics
    self._camera = self._physics.model.name2id(camera, 'camera')
    self._renderer = frame_renderer.FrameRenderer(
        self._physics.model.ptr, height, width
    )

  def draw(self) -> bytes:
    """Returns a picture of the present state."""
    self._physics.refresh()
    return jpeg(self._renderer.draw(self._physics.data.ptr, self._camera))

  def close(self) -> None:
    """Frees the graphics resources."""
    self._renderer.free()


def jpeg(frame: np.ndarray) -> bytes:
  """Returns a frame, `(height, width, 3)` uint8, as JPEG."""
  file = io.BytesIO()
  Image.fromarray(frame).save(file, 'JPEG', quality=_QUALITY)
  return file.getvalue()


def first_person(env: Any, height: int = 480, width: int = 640) -> View:
  """Returns the view of the avatar."""
  camera = env.task.avatar.camera.full_identifier
  return View(env, camera, height, width)

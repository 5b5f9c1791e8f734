"""View of the avatar for the page of a person, as JPEG."""

import io
from typing import Any, final

from PIL import Image

from realab_suite.engine import frame_renderer

_HEIGHT, _WIDTH, _QUALITY = 480, 640, 80


@final
class View:
  """View of the avatar."""

  def __init__(self, env: Any) -> None:
    """Initializes the view. Only the present thread can use it.

    Args:
      env: Environment with a task of this package.

    Raises:
      RenderingError: If no renderer is available.
    """
    self._physics = env.thin_physics
    camera = env.task.avatar.camera.full_identifier
    self._camera = self._physics.model.name2id(camera, 'camera')
    self._renderer = frame_renderer.FrameRenderer(
        self._physics.model.ptr, _HEIGHT, _WIDTH
    )

  def draw(self) -> bytes:
    """Returns a picture of the present state."""
    self._physics.refresh()
    frame = self._renderer.draw(self._physics.data.ptr, self._camera)
    file = io.BytesIO()
    Image.fromarray(frame).save(file, 'JPEG', quality=_QUALITY)
    return file.getvalue()

  def close(self) -> None:
    """Frees the graphics resources."""
    self._renderer.free()

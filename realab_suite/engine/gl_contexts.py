"""GL contexts of worlds, with the first frame and not before.

dm_control chooses a renderer when it is imported. If none is named in
`MUJOCO_GL`, its choice is GLFW even without a display, where GLFW cannot draw.
Worlds of this package are then drawn with dm_control's EGL. The choice itself,
which other programs rely on, stays as it is.
"""

import importlib
import sys
from typing import Any

from dm_control import _render
from dm_control.mujoco import engine
from dm_control.mujoco import wrapper
import numpy as np

from realab_suite import _display
from realab_suite import errors
from realab_suite.config import integers


def make(max_width: int, max_height: int) -> Any:
  """Makes a GL context of dm_control.

  Args:
    max_width: Width of the largest window, in pixels.
    max_height: Height of the largest window, in pixels.

  Raises:
    ImportError: If the renderer cannot be loaded.
    RuntimeError: If there is no renderer. Each renderer has further errors.
  """
  _display.load_llvm()
  if not _uses_egl_instead():
    return _render.Renderer(max_width, max_height)
  egl = importlib.import_module('dm_control._render.pyopengl.egl_renderer')
  return egl.EGLContext(max_width, max_height)


def for_pictures(model: wrapper.MjModel) -> engine.Contexts:
  """Makes the contexts with which dm_control renders a model for people.

  Args:
    model: Compiled model.

  Raises:
    RenderingError: If no renderer is available.
  """
  buffer = model.vis.global_
  try:
    gl = make(buffer.offwidth, buffer.offheight)
    return engine.Contexts(gl=gl, mujoco=wrapper.MjrContext(model, gl))
  except Exception as error:  # Each renderer has its own errors.
    raise errors.RenderingError(
        f'physics: no picture with {what_to_set(error)}'
    ) from error


def check_size(model: wrapper.MjModel, height: int, width: int) -> None:
  """Checks the height and the width of a frame for people, in pixels.

  Raises:
    SpecError: If the offscreen buffer of the model has no room for the frame.
  """
  buffer = model.vis.global_
  more = ', the offscreen buffer of the model'
  integers.check('height', height, 1, buffer.offheight, more=more)
  integers.check('width', width, 1, buffer.offwidth, more=more)


def frame(
    physics: engine.Physics, camera: str | int, height: int, width: int
) -> np.ndarray:
  """Renders a frame of one world for people, `(height, width, 3)` uint8.

  Raises:
    RenderingError: If no renderer is available, or if it fails.
    SpecError: As in `check_size`.
  """
  check_size(physics.model, height, width)
  try:
    picture: np.ndarray = physics.render(height, width, camera_id=camera)
  except (RuntimeError, ValueError) as error:  # All that dm_control raises.
    raise errors.RenderingError(
        f'{camera}: no frame of {height} x {width} pixels'
        f' ({str(error).strip().splitlines()[0]})'
    ) from error
  return picture


def what_to_set(error: Exception) -> str:
  """Returns advice on an error of `make`, or of drawing with its result."""
  if not _uses_egl_instead():
    return _display.what_to_set(_render.BACKEND, error)
  if 'dm_control.viewer' in sys.modules:
    return (
        'EGL, because the viewer of dm_control has prepared OpenGL for windows;'
        ' set MUJOCO_GL=egl before Python starts'
    )
  return _display.what_to_set('egl', error)


def _uses_egl_instead() -> bool:
  """Returns True if dm_control has chosen GLFW, and GLFW cannot draw."""
  is_glfw = _render.BACKEND == 'glfw'
  return is_glfw and not (_display.is_named() or _display.has_display())

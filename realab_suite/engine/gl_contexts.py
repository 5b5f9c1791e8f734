"""GL contexts of worlds, with the first frame and not before.

dm_control chooses a renderer when it is imported. If none is named in
`MUJOCO_GL`, its choice is GLFW even without a display, where GLFW cannot draw.
Worlds of this package are then drawn with dm_control's EGL. The choice itself,
which other programs rely on, stays as it is.

dm_control remembers which context it made current, but other libraries change
it, draw in whatever context is current, and free their textures there. So a
context of this module is current only while it draws.
"""

import atexit
from collections.abc import Callable, Iterator
import contextlib
import functools
import gc
import importlib
import os
import sys
import threading
from typing import Any
import weakref

from dm_control import _render
from dm_control._render import base
from dm_control._render import executor
from dm_control.mujoco import engine
from dm_control.mujoco import wrapper
import numpy as np

from realab_suite import _display
from realab_suite import errors
from realab_suite.config import integers

_EGL = 'dm_control._render.pyopengl.egl_renderer'
_references: list[weakref.ref[Any]] = []
_parent_ids: list[int] = []


class _Guest(base.ContextBase):
  """A GL context after whose use the one before it is current again."""

  # Returns a function that makes the present GL context current.
  _keep: Callable[[], Callable[[], Any]]

  def __init__(self, width: int, height: int, *unused_executor: Any) -> None:
    with self._as_guest():
      # Draws in the thread that asks for it, also with OSMesa.
      super().__init__(width, height, executor.PassthroughRenderExecutor)
    reference = weakref.ref(self)
    _references.append(reference)
    # At exit, GL may have ended. Handlers run in reverse order, so this one
    # precedes dm_control's, which would free the context.
    atexit.register(_abandon, reference)

  @contextlib.contextmanager
  def make_current(self) -> Iterator[Any]:
    """Returns a context in which this GL context is current."""
    _refuse_forks()
    with self._render_executor.execution_context() as call, self._as_guest():
      _switch(self._platform_make_current)
      yield call

  def _free_on_executor_thread(self) -> None:
    # Where another library's context cannot be replaced, the system frees it.
    with contextlib.suppress(errors.RenderingError), self._as_guest():
      super()._free_on_executor_thread()

  @contextlib.contextmanager
  def _as_guest(self) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
      # If a renderer of others were collected, it would free its textures here.
      if gc.isenabled():
        gc.disable()
        stack.callback(gc.enable)
      stack.callback(_switch, self._keep())
      yield


def _refuse_forks() -> None:
  if _parent_ids:
    raise errors.ForkError(
        f'camera: process {_parent_ids[0]} started GL before it forked this'
        ' one, so rendering would hang; start processes with spawn, or fork'
        ' before the first frame'
    )


def _record_fork() -> None:
  if _references and not _parent_ids:
    _parent_ids.append(os.getppid())
    for reference in _references:
      _abandon(reference)


os.register_at_fork(after_in_child=_record_fork)


def _abandon(reference: weakref.ref[Any]) -> None:
  """Leaves a GL context to the operating system, marked as freed."""
  if (gl := reference()) is not None:
    gl._render_executor._terminated = True


def _switch(make_current: Callable[[], Any]) -> None:
  try:
    make_current()
  except Exception as error:  # Each renderer has its own errors.
    raise errors.RenderingError(
        'camera: the GL context that another library uses in'
        f' {threading.current_thread().name} cannot be replaced; release it'
        ' before each frame, or draw in another thread'
    ) from error


def _keep_egl() -> Callable[[], Any]:
  renderer = importlib.import_module(_EGL)
  egl = renderer.EGL
  return functools.partial(
      egl.eglMakeCurrent,
      egl.eglGetCurrentDisplay() or renderer.EGL_DISPLAY,
      egl.eglGetCurrentSurface(egl.EGL_DRAW),
      egl.eglGetCurrentSurface(egl.EGL_READ),
      egl.eglGetCurrentContext(),
  )


def _keep_glfw() -> Callable[[], Any]:
  glfw = importlib.import_module('glfw')
  window = glfw.get_current_context()
  return functools.partial(glfw.make_context_current, window)


def _keep_osmesa() -> Callable[[], Any]:
  osmesa = importlib.import_module('OpenGL.osmesa')
  context = osmesa.OSMesaGetCurrentContext()
  if not context:
    return functools.partial(osmesa.OSMesaMakeCurrent, None, None, 0, 0, 0)
  width, height, _, buffer = osmesa.OSMesaGetColorBuffer(context)
  kind = osmesa.OSMesaGetIntegerv(osmesa.OSMESA_TYPE)
  return functools.partial(
      osmesa.OSMesaMakeCurrent, context, buffer, kind, width, height
  )


_KEEP = {'egl': _keep_egl, 'glfw': _keep_glfw, 'osmesa': _keep_osmesa}


def make(max_width: int, max_height: int) -> Any:
  """Makes a GL context of dm_control.

  Args:
    max_width: Width of the largest window, in pixels.
    max_height: Height of the largest window, in pixels.

  Raises:
    ForkError: If GL was started before this process was forked.
    ImportError: If the renderer cannot be loaded.
    RuntimeError: If there is no renderer. Each renderer has further errors.
  """
  _refuse_forks()
  _display.load_llvm()
  renderer, name = _render.Renderer, _render.BACKEND
  if _uses_egl_instead():
    renderer, name = importlib.import_module(_EGL).EGLContext, 'egl'
  if name in _KEEP:
    kind: dict[str, Any] = {'_keep': staticmethod(_KEEP[name])}
    renderer = type('Guest', (renderer, _Guest), kind)
  return renderer(max_width, max_height)


def for_pictures(model: wrapper.MjModel) -> engine.Contexts:
  """Makes the contexts with which dm_control renders a model for people.

  Args:
    model: Compiled model.

  Raises:
    ForkError: If GL was started before this process was forked.
    RenderingError: If no renderer is available.
  """
  buffer = model.vis.global_
  try:
    gl = make(buffer.offwidth, buffer.offheight)
    return engine.Contexts(gl=gl, mujoco=wrapper.MjrContext(model, gl))
  except errors.RealabError:
    raise
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

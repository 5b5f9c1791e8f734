"""Draws frames for agents: as plain as they are small, and soon done.

Films for people are drawn by dm_control, at the quality that the model asks
for. Here the quality is that of a copy of the model, made for one size of
frames: no multisampling, no shadows, a buffer of the size of the frame, and
coarse meshes. What there is to see, and its colours, stay the same.
"""

import atexit
import copy
import os
import threading
from typing import Any, final
import weakref

from dm_control import _render
import mujoco
import numpy as np

from realab_suite import _display
from realab_suite import errors

# Corners around, and rings along, what is round.
_SLICES, _STACKS = 12, 6
# Beyond the geoms and sites of the model; nothing else is drawn by default.
_SPARE_GEOMS = 100


@final
class _Threads(threading.local):
  """The GL context of each thread that draws.

  All frames of a thread are drawn in one: in software each takes about 100 MB.
  It is of dm_control's kind, which keeps count of the current one; a context
  made otherwise would draw dm_control's films into nowhere.
  """

  gl: Any = None


_threads = _Threads()
_started: list[Any] = []
_forked_from: list[int] = []
# Freed by whoever had the wrong GL context, they would take others' textures.
_abandoned: list[mujoco.MjrContext] = []


@final
class FrameRenderer:
  """Draws what the cameras of a model see, as frames of one size."""

  def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
    """Prepares to draw; this thread alone can do it.

    Args:
      model: The model, which is left as it is.
      height: Of a frame, pixels.
      width: Of a frame, pixels.

    Raises:
      ForkError: If GL was started before this process was forked.
      RenderingError: If nothing renders here.
    """
    _refuse_forks()
    self._model = model
    self._size = height, width
    self._thread = threading.current_thread()
    self._rect = mujoco.MjrRect(0, 0, width, height)
    self._scene = mujoco.MjvScene(
        model, maxgeom=model.ngeom + model.nsite + _SPARE_GEOMS
    )
    self._option = mujoco.MjvOption()
    self._camera = mujoco.MjvCamera()
    self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    try:
      self._gl = _start()
      with self._gl.make_current():
        self._context = mujoco.MjrContext(
            _plain(model, height, width), mujoco.mjtFontScale.mjFONTSCALE_50
        )
    except Exception as error:  # Each renderer fails by errors of its own.
      raise errors.RenderingError(
          f'camera: no frame of {height} x {width} pixels with'
          f' {what_to_set(error)}, or camera_size to None'
      ) from error
    self._gl.increment_refcount()
    # What is dropped is freed as well; at exit, GL ends before Python does.
    self._finalizer = weakref.finalize(
        self, _free, self._gl, self._context, self._thread
    )
    self._finalizer.atexit = False

  def draw(self, data: mujoco.MjData, camera_id: int) -> np.ndarray:
    """Draws what a camera sees.

    Args:
      data: The state, positions brought up to date.
      camera_id: Which of the model's cameras looks.

    Returns:
      `(height, width, 3)` uint8, the caller's own.

    Raises:
      ForkError: If this process was forked since the first frame.
      RenderingError: If another thread asks than at the first frame.
    """
    _refuse_forks()
    if threading.current_thread() is not self._thread:
      raise errors.RenderingError(
          f'camera: asked by {threading.current_thread().name}; allowed is the'
          ' thread that got the first frame'
      )
    self._camera.fixedcamid = camera_id
    mujoco.mjv_updateScene(
        self._model, data, self._option, None, self._camera,
        mujoco.mjtCatBit.mjCAT_ALL, self._scene,
    )  # fmt: skip
    upside_down = np.empty((*self._size, 3), np.uint8)
    with self._gl.make_current():
      # Another renderer of this thread may have drawn into a buffer of its own.
      mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
      mujoco.mjr_render(self._rect, self._scene, self._context)
      mujoco.mjr_readPixels(upside_down, None, self._rect, self._context)
    return np.ascontiguousarray(upside_down[::-1])

  def free(self) -> None:
    """Frees what the graphics driver holds; freeing twice does nothing."""
    self._finalizer()


def what_to_set(error: Exception) -> str:
  """Returns the renderer that failed, why, and which ones there are."""
  return (
      f'MUJOCO_GL={_render.BACKEND or "disable"} ({_first_line(error)});'
      ' set MUJOCO_GL to egl (headless), glfw (with a display) or osmesa'
      ' before Python starts'
  )


def _plain(model: mujoco.MjModel, height: int, width: int) -> mujoco.MjModel:
  """Returns a copy of a model that is drawn fast."""
  plain = copy.copy(model)
  quality, buffer = plain.vis.quality, plain.vis.global_
  quality.offsamples = quality.shadowsize = 0
  quality.numslices, quality.numstacks = _SLICES, _STACKS
  buffer.offheight, buffer.offwidth = height, width
  # A floor is cut into tiles of its third size; with the tiny ones that are
  # common it takes more time than everything on it.
  planes = plain.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  plain.geom_size[planes, 2] = plain.geom_size[planes, :2].max(axis=-1)
  return plain


def _start() -> Any:
  """Returns the GL context of this thread, which is made once."""
  if _threads.gl is None or _threads.gl.terminated:
    _display.load_llvm()
    _threads.gl = _render.Renderer(max_width=1, max_height=1)
    reference = weakref.ref(_threads.gl)
    _started.append(reference)
    if threading.current_thread() is not threading.main_thread():
      # At exit the main thread would free what belongs to this one, and fail.
      # Exit handlers run last first, so this one comes before dm_control's.
      atexit.register(_leave, reference)
  return _threads.gl


def _free(
    gl: Any, context: mujoco.MjrContext, thread: threading.Thread
) -> None:
  """Frees a drawing context where GL knows it, and leaves it be elsewhere."""
  if gl.terminated:
    _abandoned.append(context)
  elif threading.current_thread() is thread:
    with gl.make_current():
      context.free()
    gl.decrement_refcount()
    if thread is not threading.main_thread():
      gl.free()  # Unless another renderer needs it: later would be elsewhere.
  else:
    _abandoned.append(context)
    if not thread.is_alive():
      _disown(gl)


def _leave(reference: weakref.ref[Any]) -> None:
  """Leaves a GL context to the operating system."""
  if (gl := reference()) is not None:
    _disown(gl)


def _disown(gl: Any) -> None:
  """Lets dm_control believe that a GL context has been freed."""
  gl._render_executor._terminated = True


def _refuse_forks() -> None:
  if _forked_from:
    raise errors.ForkError(
        f'camera: GL was started before process {_forked_from[0]} forked this'
        ' one, where it would hang; start processes by spawn, or fork before'
        ' the first frame'
    )


def _note_fork() -> None:
  if _started and not _forked_from:
    _forked_from.append(os.getppid())
    for reference in _started:
      _leave(reference)


os.register_at_fork(after_in_child=_note_fork)


def _first_line(error: Exception) -> str:
  return (str(error).strip() or type(error).__name__).splitlines()[0]

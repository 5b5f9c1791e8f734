"""A fast renderer of small frames for the observations of agents.

It renders a copy of the model with settings for speed: no multisampling, no
shadows, coarser meshes, and a buffer of the size of the frame. Objects and
colours do not change. dm_control renders the films for people.
"""

import copy
import threading
from typing import Any, final
import weakref

import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import gl_contexts

# Slices and stacks of the meshes of round geoms.
_SLICES, _STACKS = 12, 6
# Room for geoms besides those of the model's geoms and sites.
_SPARE_GEOMS = 100


@final
class _Threads(threading.local):
  """GL context of the current thread.

  A thread has a single context, because each takes about 100 MB with software
  rendering.

  Attributes:
    gl: The context; `None` before the first frame.
  """

  gl: Any = None


_threads = _Threads()
# Freeing these in the wrong GL context would delete textures of others.
_unfreed: list[mujoco.MjrContext] = []


@final
class FrameRenderer:
  """Renders cameras of a model, as frames of one size."""

  def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
    """Initializes the renderer. Only the present thread can use it.

    Args:
      model: Compiled model. It is copied.
      height: Height of a frame, in pixels.
      width: Width of a frame, in pixels.

    Raises:
      ForkError: If GL was started before this process was forked.
      RenderingError: If no renderer is available.
    """
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
    except errors.RealabError:
      raise
    except Exception as error:  # Each renderer has its own errors.
      raise errors.RenderingError(
          f'camera: no frame of {height} x {width} pixels with'
          f' {gl_contexts.what_to_set(error)}, or select senses without the'
          ' camera'
      ) from error
    self._gl.increment_refcount()
    # Frees the context at garbage collection as well, but not at exit, because
    # GL ends before Python.
    self._finalizer = weakref.finalize(
        self, _free, self._gl, self._context, self._thread
    )
    self._finalizer.atexit = False

  def draw(self, data: mujoco.MjData, camera_id: int) -> np.ndarray:
    """Renders the view of a camera.

    Args:
      data: State of the world, with up-to-date derived positions.
      camera_id: Number of the camera in the model.

    Returns:
      A new array, `(height, width, 3)` uint8.

    Raises:
      ForkError: If this process was forked after the first frame.
      RenderingError: If the renderer was created in another thread.
    """
    if threading.current_thread() is not self._thread:
      raise errors.RenderingError(
          f'camera: rendering in {threading.current_thread().name}; must be'
          ' the thread that rendered the first frame'
      )
    self._camera.fixedcamid = camera_id
    mujoco.mjv_updateScene(
        self._model,
        data,
        self._option,
        None,
        self._camera,
        mujoco.mjtCatBit.mjCAT_ALL,
        self._scene,
    )
    flipped = np.empty((*self._size, 3), np.uint8)
    with self._gl.make_current():
      # Another renderer of this thread may have selected its own buffer.
      mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
      mujoco.mjr_render(self._rect, self._scene, self._context)
      mujoco.mjr_readPixels(flipped, None, self._rect, self._context)
    return np.ascontiguousarray(flipped[::-1])

  def free(self) -> None:
    """Frees the graphics resources. Freeing them again has no effect."""
    self._finalizer()


def _plain(model: mujoco.MjModel, height: int, width: int) -> mujoco.MjModel:
  """Returns a copy of a model with settings for fast rendering."""
  plain = copy.copy(model)
  quality, buffer = plain.vis.quality, plain.vis.global_
  quality.offsamples = quality.shadowsize = 0
  quality.numslices, quality.numstacks = _SLICES, _STACKS
  buffer.offheight, buffer.offwidth = height, width
  # MuJoCo divides a plane into tiles of its third size. Tiles are often tiny,
  # and then the floor takes more time than everything on it.
  planes = plain.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  plain.geom_size[planes, 2] = plain.geom_size[planes, :2].max(axis=-1)
  return plain


def _start() -> Any:
  """Returns the GL context of this thread, which is created once."""
  if _threads.gl is None or _threads.gl.terminated:
    _threads.gl = gl_contexts.make(1, 1)
  return _threads.gl


def _free(
    gl: Any, context: mujoco.MjrContext, thread: threading.Thread
) -> None:
  """Frees a rendering context, and the GL context of a lesser thread."""
  if gl.terminated:
    _unfreed.append(context)
    return
  with gl.make_current():
    context.free()
  gl.decrement_refcount()
  if thread is not threading.main_thread():
    gl.free()  # Has no effect while another renderer uses it.

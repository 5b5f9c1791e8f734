"""Recordings of a world in 3D, as a page that a browser opens offline.

viser draws the scene and contains the player, and mjviser converts the compiled
model. The page has two recordings of the same episode: one with a free camera,
and one whose camera follows the avatar's.
"""

import base64
import contextlib
import copy
from importlib import resources
import io
from typing import Any, final

import mjviser
import mujoco
import numpy as np
import viser
from viser import _messages

from realab_suite.engine import environment
from realab_suite.interop.browser import servers

# Time for which the player shows the end of the episode, in seconds.
_END = 1.5
# Position of the free camera at the start, relative to the centre of the floor
# and in units of its size.
_OFFSET = np.array([-0.3, -0.65, 0.75])
_FLOOR = (205, 208, 214)
# The first-person recording is chosen by the fragment of the address, because
# viser's player reads its recording only when it starts.
_CHOICE = (
    '<script>if (location.hash.startsWith("#first"))'
    ' window.__VISER_EMBED_DATA__ = "{}";</script>'
)


def with_timeline(page: str, data: str) -> str:
  """Returns the page of a recording with a time line below the scene.

  Args:
    page: Page of a recording.
    data: Data of the time line, as JSON.
  """
  pages = resources.files('realab_suite.interop.browser') / 'pages'
  timeline = (pages / 'timeline.html').read_text(encoding='utf-8')
  # A text in the data cannot end the element that contains it.
  timeline = timeline.replace('@DATA@', data.replace('<', '\\u003c'))
  return page.replace('</body>', timeline + '</body>', 1)


@final
class Recording:
  """A recording of an episode, made while the episode runs."""

  def __init__(self, env: environment.Environment) -> None:
    """Starts to record.

    Args:
      env: Environment with a task of this package, after a reset.
    """
    self._env = env
    physics = env.thin_physics
    self._timestep = env.control_timestep()
    self._camera = physics.bind(env.task.avatar.camera)
    # mjviser changes the appearance of the model.
    model = copy.copy(physics.model.ptr)
    with _silence():
      # The scene belongs to a server, to which nothing connects.
      self._server = viser.ViserServer(servers.LOCAL, port=0, verbose=False)
    self._scene = mjviser.ViserMujocoScene(self._server, model, num_envs=1)
    self._scene.camera_tracking_enabled = False
    # Shadows need most of the draw calls of a frame, which takes seconds
    # without a graphics processor.
    self._server.scene.configure_default_lights(cast_shadow=False)
    centre, size = _floor(self._server, model, physics.data.ptr)
    self._free = self._server.get_scene_serializer()
    self._first_person = self._server.get_scene_serializer()
    start = centre + _OFFSET * size
    for message in _look(start, centre, np.array([0.0, 0.0, 1.0]), True):
      self._free._insert_message(message)
    fov = np.deg2rad(float(np.ravel(self._camera.fovy)[0]))
    self._follow(_messages.SetCameraFovMessage(float(fov)))
    self._num_frames = 0

  def add(self) -> None:
    """Records the present state of the world, one control step later."""
    if self._num_frames:
      self._wait(self._timestep)
    self._num_frames += 1
    physics = self._env.thin_physics
    physics.refresh()
    self._scene.update_from_mjdata(physics.data.ptr)
    position = np.ravel(self._camera.xpos)
    axes = np.reshape(self._camera.xmat, (3, 3))
    # A camera of MuJoCo looks along its negative z axis.
    ahead, up = position - axes[:, 2], axes[:, 1]
    for message in _look(position, ahead, up, False):
      self._follow(message)

  def page(self) -> str:
    """Returns the page, and ends the recording."""
    self._wait(_END)
    page = self._free.as_html()
    data = base64.b64encode(self._first_person.serialize()).decode('ascii')
    self.close()
    return page.replace('</head>', _CHOICE.format(data) + '</head>', 1)

  def close(self) -> None:
    """Stops the server; without a call of `page`, the recording is lost."""
    with _silence():
      self._server.stop()

  def _wait(self, seconds: float) -> None:
    for recording in (self._free, self._first_person):
      recording.insert_sleep(seconds)

  def _follow(self, message: Any) -> None:
    # viser has no public method that records a message to move cameras.
    self._first_person._insert_message(message)


def _look(
    position: np.ndarray, at: np.ndarray, up: np.ndarray, initial: bool
) -> list[Any]:
  """Returns messages that move the camera of a player."""
  return [
      _messages.SetCameraUpDirectionMessage(_triple(up), initial),
      _messages.SetCameraPositionMessage(_triple(position), initial),
      _messages.SetCameraLookAtMessage(_triple(at), initial),
  ]


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
  x, y, z = (float(value) for value in vector)
  return x, y, z


def _floor(
    server: viser.ViserServer, model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[np.ndarray, float]:
  """Replaces endless planes by a floor; returns its centre and its size."""
  planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  for i in np.flatnonzero(planes):
    body = mjviser.conversions.get_body_name(model, model.geom_bodyid[i])
    geom = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i)
    server.scene.remove_by_name(f'/fixed_bodies/{body}/{geom}')
  positions = data.geom_xpos[~planes, :2]
  low, high = positions.min(axis=0) - 0.3, positions.max(axis=0) + 0.3
  centre = np.append((low + high) / 2, 0.0)
  server.scene.add_box(
      '/floor',
      color=_FLOOR,
      dimensions=(*(high - low), 0.02),
      position=(*centre[:2], -0.011),
      cast_shadow=False,
  )
  return centre, float((high - low).max())


def _silence() -> contextlib.AbstractContextManager[Any]:
  """Returns a context in which viser prints nothing."""
  return contextlib.redirect_stdout(io.StringIO())

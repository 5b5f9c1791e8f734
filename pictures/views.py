"""Views of a world for people: smooth frames, and places of objects in them."""

from collections.abc import Iterable
import dataclasses
from typing import Any, final

from dm_control.mujoco import engine
import mujoco
import numpy as np
from PIL import Image

from realab_suite import errors
from realab_suite.engine import environment

# Frames are rendered larger by this factor and reduced, for smooth edges.
_FINER = 2
# Size of the buffer of the renderer, in pixels.
_LARGEST = 2560
# Least number of visible pixels of an object.
_FEWEST = 60


@final
@dataclasses.dataclass(frozen=True)
class Pose:
  """Pose of a camera outside the avatar.

  Attributes:
    lookat: Point in the middle of the frame, `(x, y, z)`, in m.
    distance: Distance of the camera from this point, in m.
    azimuth: Direction of view from above: the angle to the x axis, in degrees.
    elevation: Angle of the view to the horizontal, in degrees; negative for a
      view from above.
  """

  lookat: tuple[float, float, float]
  distance: float
  azimuth: float
  elevation: float

  def axes(self) -> np.ndarray:
    """Returns the unit vectors right, up and forward, `(3, 3)`."""
    azimuth, elevation = np.radians([self.azimuth, self.elevation])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + [0.0, 0.0, np.sin(elevation)]
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(right, forward), forward])


@final
class View:
  """A camera and the size of its frames."""

  def __init__(
      self,
      env: environment.Environment,
      size: tuple[int, int],
      pose: Pose | None = None,
  ) -> None:
    """Makes the camera.

    Args:
      env: Environment with a task of this package.
      size: Width and height of a frame, in pixels.
      pose: Pose of the camera; `None` for the camera of the avatar.
    """
    self._env = env
    self._size = size
    self._pose = pose
    limits = env.physics.model.vis.global_
    limits.offwidth = limits.offheight = _LARGEST
    width, height = (_FINER * pixels for pixels in size)
    if pose is None:
      name = env.task.avatar.camera.full_identifier
      self._camera = engine.Camera(env.physics, height, width, name)
    else:
      self._camera = engine.MovableCamera(env.physics, height, width)
      self._camera.set_pose(**dataclasses.asdict(pose))

  def frame(self) -> Image.Image:
    """Returns a frame of the present state."""
    self._env.thin_physics.refresh()
    picture = Image.fromarray(self._camera.render())
    return picture.resize(self._size, Image.Resampling.LANCZOS)

  def pixels(self, geoms: Iterable[int]) -> dict[int, np.ndarray]:
    """Returns the visible pixels of geoms in the frame.

    Args:
      geoms: Numbers of geoms.

    Returns:
      By the number of the geom, `(pixels, 2)`, as `(x, y)`. Geoms of which less
      than `_FEWEST` pixels are visible are left out.
    """
    self._env.thin_physics.refresh()
    numbers, kinds = np.moveaxis(self._camera.render(segmentation=True), -1, 0)
    numbers = np.where(kinds == mujoco.mjtObj.mjOBJ_GEOM, numbers, -1)
    seen = {g: np.argwhere(numbers == g)[:, ::-1] / _FINER for g in geoms}
    fewest = _FEWEST * _FINER**2
    return {g: pixels for g, pixels in seen.items() if len(pixels) >= fewest}

  def place_of(self, point: Any) -> tuple[float, float]:
    """Returns the pixel of a point in a frame of a camera with a pose.

    Args:
      point: `(x, y, z)`, in m.

    Raises:
      SpecError: If the camera is that of the avatar.
    """
    pose = self._pose
    if pose is None:
      raise errors.SpecError(
          'pose: None; allowed for place_of are poses outside the avatar'
      )
    axes = pose.axes()
    offset = np.subtract(point, pose.lookat) + pose.distance * axes[2]
    right, up, forward = axes @ offset
    width, height = self._size
    angle = np.radians(self._env.physics.model.vis.global_.fovy)
    scale = height / 2 / np.tan(angle / 2) / forward
    return width / 2 + scale * right, height / 2 - scale * up

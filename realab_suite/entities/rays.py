"""Ray sense: distances and classes of the nearest geoms. Needs no GL."""

import functools
from typing import final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import modelled
from realab_suite.entities import protocols

# Range of the rays, in m.
_MAX_DISTANCE = 12.0


@functools.singledispatch
def cast(
    physics: protocols.Physics,
    origin: np.ndarray,
    directions: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray]:
  """Casts rays.

  Engines for batches of worlds register their own implementations.

  Args:
    physics: One world, or a batch of worlds if the engine supports it.
    origin: Common origin of the rays, `(..., 3)`, in m.
    directions: Unit vectors, `(..., rays, 3)`.
    excluded_body: Index of a body whose geoms the rays pass through.

  Returns:
    Distances, in m, and indices of the geoms that the rays hit first, each
    `(..., rays)`; both are -1 for a ray that hits nothing.

  Raises:
    NotImplementedError: If the engine cannot cast rays.
  """
  raise NotImplementedError(f'{type(physics).__name__} cannot cast rays')


def look(
    physics: protocols.Physics,
    eye: np.ndarray,
    place: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Looks from an eye towards a place, at the height of the eye.

  Args:
    physics: As for `cast`.
    eye: Position of the eye, `(..., 3)`, in m.
    place: Place to look at, `(..., 2)`, in m.
    excluded_body: Index of the body of the eye, which does not hide anything.

  Returns:
    Direction of the place, a unit vector `(..., 2)`; its distance and that of
    the nearest geom on the way, each `(...)`, in m.
  """
  way = np.zeros_like(eye)
  way[..., :2] = place - eye[..., :2]
  distance = np.linalg.norm(way, axis=-1)
  way = way / distance[..., np.newaxis].clip(1e-6)
  free, _ = cast(physics, eye, way[..., np.newaxis, :], excluded_body)
  return way[..., :2], distance, free[..., 0]


@cast.register
def _(
    physics: mjcf.Physics,
    origin: np.ndarray,
    directions: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray]:
  num_rays = len(directions)
  geoms = np.empty(num_rays, np.int32)
  distances = np.empty(num_rays)
  mujoco.mj_multiRay(
      physics.model.ptr,
      physics.data.ptr,
      np.ascontiguousarray(origin, np.float64),
      np.ascontiguousarray(directions, np.float64).ravel(),
      None,  # All geom groups.
      1,  # Static geoms included.
      excluded_body,
      geoms,
      distances,
      None,  # No normals.
      num_rays,
      mujoco.mjMAXVAL,
  )
  return distances, geoms


@final
class RaySense(modelled.ModelledEntity):
  """A fan of horizontal rays from the centre of the body that carries it.

  The rays are just above the floor, at the height of the blocks. They hit
  everything that a camera at that height would see, including geoms without
  collisions, and report the code of a class (`appearance.code`) instead of a
  colour.
  """

  def _build(
      self,
      name: str = 'rays',
      num_rays: int = 32,
      field_of_view: float = 160.0,
  ) -> None:
    """Builds the sense.

    Args:
      name: Name of the model.
      num_rays: Number of rays, at least 2.
      field_of_view: Angle between the outermost rays, in degrees.

    Raises:
      SpecError: If `num_rays` is less than 2.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    if num_rays < 2:
      raise errors.SpecError(f'num_rays: {num_rays}; must be at least 2')
    half = np.radians(field_of_view) / 2.0
    # From left to right, as in an image.
    self._angles = np.linspace(half, -half, num_rays)
    self._fan = np.cos(self._angles), np.sin(self._angles)
    self._class_of_geom = np.zeros(0, np.int32)
    self._nothing = appearance.code(appearance.NOTHING)
    self._physics: protocols.Physics | None = None

  @property
  def angles(self) -> np.ndarray:
    """Angle of each ray, positive to the left, `(rays,)`, in rad."""
    return self._angles

  @property
  def max_distance(self) -> float:
    """Range of the rays, in m, which is reported where nothing is hit."""
    return _MAX_DISTANCE

  def sense(self, physics: protocols.Physics) -> tuple[np.ndarray, np.ndarray]:
    """Casts the rays.

    Args:
      physics: One world or a batch of worlds.

    Returns:
      Distances in [0, max_distance], float32, in m, and class codes, int32,
      each `(..., rays)`.
    """
    if physics is not self._physics:
      self._mount(physics)
    frame = self._frame
    matrix = frame.xmat
    # The first column of the matrix is the direction of the middle of the fan.
    cos, sin = matrix[..., 0:1], matrix[..., 3:4]
    x, y = self._fan
    directions = np.zeros((*cos.shape[:-1], len(x), 3))
    np.subtract(cos * x, sin * y, out=directions[..., 0])
    np.add(sin * x, cos * y, out=directions[..., 1])
    distances, geoms = cast(physics, frame.xpos, directions, self._carrier)
    missed = (geoms < 0) | (distances > _MAX_DISTANCE)
    classes = self._class_of_geom[geoms]
    if np.count_nonzero(missed):
      classes[missed] = self._nothing
      distances[missed] = _MAX_DISTANCE
    return distances.astype(np.float32), classes

  def _mount(self, physics: protocols.Physics) -> None:
    """Binds the sense and its carrier to another physics."""
    self._frame = physics.bind(self.root_body)
    # Rays pass through the body that carries the sense.
    self._carrier = physics.bind(self.root_body.parent).element_id
    self._class_of_geom = appearance.class_of_geoms(physics.model)
    self._physics = physics

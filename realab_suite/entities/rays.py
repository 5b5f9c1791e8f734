"""A sense of what is around: rays that tell distance and class. Needs no GL."""

import functools
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import protocols


@functools.singledispatch
def cast(
    physics: protocols.Physics,
    origin: np.ndarray,
    directions: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray]:
  """Casts rays; an engine of many worlds registers its own implementation.

  Args:
    physics: One world.
    origin: Where all rays begin, `(..., 3)`, metres.
    directions: Unit vectors, `(..., rays, 3)`.
    excluded_body: The id of a body whose geoms rays pass through.

  Returns:
    Distance in metres and geom id of the first hit, each `(..., rays)`; both
    are -1 where a ray hits nothing.
  """
  raise NotImplementedError(f'no rays are cast in a {type(physics).__name__}')


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
      1,  # Static geoms too.
      excluded_body,
      geoms,
      distances,
      None,  # No normals.
      num_rays,
      mujoco.mjMAXVAL,
  )
  return distances, geoms


@final
class RayObservables(composer.Observables):
  """What the rays hit."""

  @composer.observable
  def distances(self) -> observable.Generic:
    return observable.Generic(self._entity.distances)

  @composer.observable
  def classes(self) -> observable.Generic:
    return observable.Generic(self._entity.classes)


@final
class RaySense(composer.Entity):
  """A fan of horizontal rays from the middle of whatever carries it.

  The rays run close above the floor, where blocks are. They see everything that
  a camera there would see, things that nothing collides with included, and they
  see it by class (`appearance.CLASSES`) instead of by pixel.
  """

  def _build(
      self,
      name: str = 'rays',
      num_rays: int = 32,
      field_of_view: float = 160.0,
      max_distance: float = 12.0,
  ) -> None:
    """Builds the sense.

    Args:
      name: The name of the model.
      num_rays: How many rays.
      field_of_view: The angle between the outermost rays, degrees.
      max_distance: What a ray reports that hits nothing nearer, metres.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    if num_rays < 2:
      raise errors.SpecError(f'num_rays: {num_rays}; allowed are 2 and more')
    half = np.radians(field_of_view) / 2.0
    # From left to right, as in a picture.
    self._angles = np.linspace(half, -half, num_rays)
    self._fan = np.cos(self._angles), np.sin(self._angles)
    self._max_distance = max_distance
    self._class_of_geom = np.zeros(0, np.int32)
    self._model: Any = None

  def _build_observables(self) -> RayObservables:
    return RayObservables(self)

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def angles(self) -> np.ndarray:
    """Where each ray points, `(rays,)` radians, positive to the left."""
    return self._angles

  @property
  def max_distance(self) -> float:
    """What a ray reports that hits nothing, metres."""
    return self._max_distance

  @property
  def num_classes(self) -> int:
    """How many classes a ray tells apart, `nothing` included."""
    return len(appearance.CLASSES)

  def sense(self, physics: protocols.Physics) -> tuple[np.ndarray, np.ndarray]:
    """Casts the rays.

    Returns:
      Distances, float32 metres in [0, max_distance], and class codes, int32
      indices into `appearance.CLASSES`, each `(..., rays)`.
    """
    if physics.model is not self._model:
      self._mount(physics)
    frame = physics.bind(self._frame)
    matrix = frame.xmat
    # The first column of the matrix is where the sense faces.
    cos, sin = matrix[..., 0:1], matrix[..., 3:4]
    x, y = self._fan
    directions = np.zeros((*np.shape(cos)[:-1], len(x), 3))
    directions[..., 0] = cos * x - sin * y
    directions[..., 1] = sin * x + cos * y
    distances, geoms = cast(physics, frame.xpos, directions, self._carrier)
    missed = (geoms < 0) | (distances > self._max_distance)
    classes = self._class_of_geom[geoms]
    classes[missed] = appearance.code('nothing')
    distances[missed] = self._max_distance
    return distances.astype(np.float32), classes

  def distances(self, physics: protocols.Physics) -> np.ndarray:
    """Returns how far each ray gets, `(..., rays)` float32, metres."""
    return self.sense(physics)[0]

  def classes(self, physics: protocols.Physics) -> np.ndarray:
    """Returns what each ray hits, `(..., rays)` int32 class codes."""
    return self.sense(physics)[1]

  def _mount(self, physics: protocols.Physics) -> None:
    """Finds out where the sense is in a model that it has not met before."""
    self._frame = self.root_body
    # Rays pass through the body that the sense is mounted on.
    self._carrier = physics.bind(self._frame.parent).element_id
    self._class_of_geom = appearance.class_of_geoms(physics.model)
    self._model = physics.model

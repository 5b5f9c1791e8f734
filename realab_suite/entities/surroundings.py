"""Surroundings of blocks: the immovable objects that writes must avoid.

An agent can carry a block beside a wall or a door. A write that changes only
one coordinate could then put the block into it, or beyond it. Instead, the
block is put at the nearest free coordinate, which MuJoCo's distances show.
Doors and other mocap bodies count where they are at the moment of the write.
"""

import copy
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import protocols
from realab_suite.entities import proximity

# Prefix of the names of box sites in which no block may be written: the space
# outside of rooms.
OUTSIDE = 'outside.'
# Width of such a box at the outside of a room, in m. Places beyond it are never
# the nearest free ones.
ENDLESS = 20.0
# A block is in an obstacle if this fraction of its half edge length is inside,
# or this depth, in m. Contacts push blocks out that are less deep inside, which
# is no obstruction: blocks that were pushed against a wall are slightly inside.
# From a quarter of its edge length inside, a cube of 1 m left at 15 m/s.
_TOLERANCE, _DEEPEST = 0.5, 0.05
# Precision of the nearest free coordinate, in m.
_PRECISION = 1e-6
# Writes that move a block by at most this much, in m, are rounding errors.
_SAME_PLACE = 1e-12
# Most poses of mocap bodies whose corridors are remembered. Doors that slide
# are seen in the same few poses in all worlds and episodes.
_MOST_REMEMBERED = 1000
_BOX = mujoco.mjtGeom.mjGEOM_BOX
# MuJoCo computes no bounding boxes of planes. Height fields are the ground.
_IGNORED_TYPES = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_HFIELD,
    mujoco.mjtGeom.mjGEOM_SDF,
)
# Copy of each compiled model, in which mocap bodies are posed and distances
# are measured.
_copies: weakref.WeakKeyDictionary[
    Any, tuple[mujoco.MjModel, mujoco.MjData]
] = weakref.WeakKeyDictionary()


@final
class Surroundings:
  """Frame and obstacles of a block, as found in the compiled model."""

  def __init__(
      self, body: mjcf.Element, rest: np.ndarray, half_size: float
  ) -> None:
    """Initializes the surroundings of a block.

    Args:
      body: Body of the block, a child of the frame of its register.
      rest: Position of the block at rest in that frame, `(3,)`, in m.
      half_size: Half the edge length of the block, in m.
    """
    self._body = body
    self._home = self._rest = rest
    self._half_size = half_size - min(half_size * _TOLERANCE, _DEEPEST)
    self._radius = np.sqrt(3.0) * self._half_size
    self._model: Any = None
    self._origin = np.zeros(3)
    self._axes = np.eye(3)
    self._limits = self._reach = -np.inf, np.inf
    # Solid mocap bodies, such as doors, and the poses that they were last seen
    # in, `(..., bodies, 7)`.
    self._frames: tuple[mjcf.Element, ...] = ()
    self._poses = np.zeros((0, 7))
    self._physics: protocols.Physics | None = None
    self._bound: Any = None
    self._seen = b''
    # Bounds between which no obstacle is, whatever value is written: the least
    # y and z, and the largest ones, `(4, ...)`.
    self._corridor = np.zeros(4)
    # Those of one world, by the poses in it as bytes.
    self._remembered: dict[bytes, np.ndarray] = {}

  def limit(self, low: float, high: float) -> None:
    """Sets the x coordinates at which undisturbed blocks are written, in m."""
    self._limits = self._reach = low, high
    self._model = None

  def shift(self, displacement: np.ndarray) -> None:
    """Sets the displacement of these, for registers that are moved.

    Args:
      displacement: Displacement in the frame of the register, `(2,)`, in m.
    """
    along, aside = displacement
    rest = self._home + np.array([along, aside, 0.0])
    if np.array_equal(rest, self._rest):
      return
    self._rest = rest
    low, high = self._limits
    self._reach = low + along, high + along
    self._model = None

  def are_far(self, physics: protocols.Physics, position: Any) -> Any:
    """Returns True if no obstacle is near, whatever value is written.

    This test is fast, and returns True for most undisturbed blocks.

    Args:
      physics: One world or a batch of worlds.
      position: Position in the frame of the register, `(..., 3)`, in m.

    Returns:
      `(...)` bool.
    """
    if physics.model is not self._model:
      self._resolve(physics)
    if self._frames:
      self._follow(physics)
    right, floor, left, ceiling = self._corridor
    _, y, z = position.T
    return (right < y) & (y < left) & (floor < z) & (z < ceiling)

  def nearest_free(
      self,
      world: tuple[int, ...],
      position: np.ndarray,
      axes: np.ndarray,
      before: float,
  ) -> float:
    """Returns the free x coordinate that is nearest to a wanted one, in m.

    An obstacle that the block is inside already does not count; contacts push
    the block out of it. Call `are_far` first, which finds the obstacles.

    Args:
      world: Index of the world, `()` for one world.
      position: Wanted position of the block in this world, `(3,)`, in m.
      axes: Axes of the block, as columns, `(3, 3)`.
      before: Present x coordinate of the block, in m.
    """
    along, y, z = position.tolist()
    if abs(along - before) <= _SAME_PLACE:
      return along
    poses = self._poses[world] if self._frames else self._poses
    centres, turned, low, high = self._locate(poses)
    is_beside = (low[:, 1:] < [y, z]) & ([y, z] < high[:, 1:])

    def is_in(obstacle: int, x: float) -> bool:
      if not low[obstacle, 0] < x < high[obstacle, 0]:
        return False
      model, data = _copies[self._model]
      # A geom takes the place of the space outside of a room.
      pair = self._block, self._geoms[obstacle]
      model.geom_type[pair[1]] = self._types[obstacle]
      model.geom_size[pair[1]] = self._sizes[obstacle]
      model.geom_type[pair[0]] = _BOX
      model.geom_size[pair[0]] = self._half_size
      distance, _ = proximity.distance(
          model,
          data,
          pair,
          ([x, y, z], centres[obstacle]),
          (axes.ravel(), turned[obstacle].ravel()),
          _PRECISION,
      )
      return distance < 0.0

    obstacles = [
        obstacle
        for obstacle in np.flatnonzero(is_beside.all(axis=1)).tolist()
        if not is_in(obstacle, before)
    ]
    ends = []
    for bounds in (low[:, 0], high[:, 0]):
      end = along
      while abs(end) < ENDLESS:
        inside = (one for one in obstacles if is_in(one, end))
        if (obstacle := next(inside, None)) is None:
          ends.append(end)
          break
        taken, end = end, float(bounds[obstacle])
        # Both are convex, so the coordinates that are taken are an interval.
        while abs(end - taken) > _PRECISION:
          middle = (taken + end) / 2
          taken, end = (
              (middle, end) if is_in(obstacle, middle) else (taken, middle)
          )
    return min(ends, key=lambda end: abs(end - along), default=along)

  def in_world(
      self, physics: protocols.Physics, position: np.ndarray
  ) -> np.ndarray:
    """Returns a position in the frame of the world, `(..., 3)`, in m.

    If the frame of the register can move, the result is far from everything.

    Args:
      physics: One world or a batch of worlds.
      position: Position in the frame of the register, `(..., 3)`, in m.
    """
    if physics.model is not self._model:
      self._resolve(physics)
    return self._origin + _product(position, self._axes.T)

  def in_frame(
      self, physics: protocols.Physics, vector: np.ndarray
  ) -> np.ndarray:
    """Returns a vector of the world in the frame of the register, `(..., 3)`.

    Args:
      physics: One world or a batch of worlds.
      vector: Vector, `(..., 3)`.
    """
    if physics.model is not self._model:
      self._resolve(physics)
    return _product(vector, self._axes)

  def _resolve(self, physics: protocols.Physics) -> None:
    """Finds frame and obstacles in a compiled model, and caches them."""
    self._model, self._physics = physics.model, None
    self._remembered.clear()
    model = physics.model
    if model not in _copies:
      copied = copy.copy(model.ptr)
      _copies[model] = copied, mujoco.MjData(copied)
    _, data = _copies[model]
    mujoco.mj_resetData(*_copies[model])
    mujoco.mj_kinematics(*_copies[model])
    body = int(physics.bind(self._body).element_id)
    self._block = int(model.body_geomadr[body])
    frame = int(model.body_parentid[body])
    self._origin = np.array(data.xpos[frame])
    self._axes = np.reshape(data.xmat[frame], (3, 3)).copy()
    carriers = model.body_weldid[model.geom_bodyid]
    is_solid = (model.geom_contype | model.geom_conaffinity) != 0
    is_solid &= ~np.isin(model.geom_type, _IGNORED_TYPES)
    is_solid &= (carriers == 0) | (model.body_mocapid[carriers] >= 0)
    if model.body_weldid[frame] != 0:
      self._origin = np.full(3, ENDLESS)
      is_solid[:] = False
    geoms = np.flatnonzero(is_solid)
    # Sites are never in the way of bodies whose frames move.
    sites = [
        site
        for site in range(model.nsite if len(geoms) else 0)
        if model.id2name(site, 'site').startswith(OUTSIDE)
    ]
    self._ids = geoms, np.array(sites, int)
    boxes = model.geom_aabb[geoms]
    self._middles = np.concatenate([boxes[:, :3], np.zeros((len(sites), 3))])
    self._halves = np.concatenate([boxes[:, 3:], model.site_size[sites]])
    # In measurements, the first geom takes the place of a site.
    self._geoms = np.append(geoms, np.zeros(len(sites), int)).tolist()
    self._types = np.append(model.geom_type[geoms], [_BOX] * len(sites))
    self._sizes = np.concatenate(
        [model.geom_size[geoms], model.site_size[sites]]
    )
    numbers = model.body_mocapid[carriers[geoms]]
    self._mocaps = np.unique(numbers[numbers >= 0])
    bodies = {
        model.body_mocapid[
            model.name2id(element.full_identifier, 'body')
        ]: element
        for element in self._body.root.root_model.find_all('body')
    }
    self._frames = tuple(bodies[number] for number in self._mocaps.tolist())
    self._poses = np.zeros((0, 7))
    if not self._frames:
      self._corridor = self._corridor_in(self._poses)

  def _follow(self, physics: protocols.Physics) -> None:
    """Adapts the corridors to the present poses of mocap bodies."""
    if physics is not self._physics:
      self._bound, self._seen = physics.bind(self._frames), b''
      self._physics = physics
    bound = self._bound
    # Most often nothing has moved, and bytes are compared fastest.
    pose_bytes = bound.mocap_pos.tobytes() + bound.mocap_quat.tobytes()
    if pose_bytes == self._seen:
      return
    self._seen = pose_bytes
    poses = np.concatenate([bound.mocap_pos, bound.mocap_quat], axis=-1)
    if poses.shape != self._poses.shape:
      self._poses = np.full_like(poses, np.nan)
      self._corridor = np.zeros((4, *poses.shape[:-2]))
    for world in np.argwhere((poses != self._poses).any(axis=(-1, -2))):
      index = tuple(world)
      self._corridor[:, *index] = self._recall_corridor(poses[index])
    self._poses = poses

  def _recall_corridor(self, poses: np.ndarray) -> np.ndarray:
    """Returns the same as `_corridor_in`, which takes longer."""
    key = poses.tobytes()
    if key not in self._remembered:
      if len(self._remembered) == _MOST_REMEMBERED:
        self._remembered.clear()
      self._remembered[key] = self._corridor_in(poses)
    return self._remembered[key]

  def _locate(self, poses: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the obstacles of one world in the frame of the register.

    Args:
      poses: Poses of the mocap bodies, `(bodies, 7)`.

    Returns:
      Their positions, `(obstacles, 3)`, axes, as columns,
      `(obstacles, 3, 3)`, and the least and the largest coordinates that the
      centre of a block beside them may have, `(obstacles, 3)` each.
    """
    model, data = _copies[self._model]
    data.mocap_pos[self._mocaps] = poses[:, :3]
    data.mocap_quat[self._mocaps] = poses[:, 3:]
    mujoco.mj_kinematics(model, data)
    geoms, sites = self._ids
    places = np.concatenate([data.geom_xpos[geoms], data.site_xpos[sites]])
    axes = np.concatenate([data.geom_xmat[geoms], data.site_xmat[sites]])
    places = (places - self._origin) @ self._axes
    axes = self._axes.T @ axes.reshape(-1, 3, 3)
    middles = places + np.einsum('nij,nj->ni', axes, self._middles)
    reach = np.einsum('nij,nj->ni', np.abs(axes), self._halves) + self._radius
    return places, axes, middles - reach, middles + reach

  def _corridor_in(self, poses: np.ndarray) -> np.ndarray:
    """Returns the bounds of the space beside obstacles; see `_corridor`.

    Args:
      poses: Poses of the mocap bodies in one world, `(bodies, 7)`.
    """
    _, _, low, high = self._locate(poses)
    # The corridor has to be free only where blocks are written.
    least, most = self._reach
    is_ahead = (low[:, 0] < most) & (high[:, 0] > least)
    low, high = low[is_ahead, 1:], high[is_ahead, 1:]
    # Most boxes are on one side of the region of the block.
    gaps = np.concatenate([self._rest[1:] - high, low - self._rest[1:]], axis=1)
    on_side = gaps.argmax(axis=1)[:, np.newaxis] == np.arange(4)
    lower = np.where(on_side[:, :2], high, -np.inf)
    upper = np.where(on_side[:, 2:], low, np.inf)
    return np.append(
        lower.max(axis=0, initial=-np.inf), upper.min(axis=0, initial=np.inf)
    )


def _product(vector: np.ndarray, matrix: np.ndarray) -> np.ndarray:
  """Returns the same as `vector @ matrix`, of 3 rows, for any number of worlds.

  The last bits of a matrix product depend on the number of worlds.
  """
  x, y, z = (vector[..., i, np.newaxis] for i in range(3))
  return x * matrix[0] + y * matrix[1] + z * matrix[2]

"""Surroundings of blocks: the immovable objects that writes must avoid.

An agent can carry a block beside a wall or a door. A write that changes only
one coordinate could then put the block into it, or beyond it. Instead, the
block is put at the nearest free coordinate. Doors and other mocap bodies count
where they are at the moment of the write.
"""

from collections.abc import Sequence
import copy
from typing import Any, Self, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import protocols
from realab_suite.entities import rotations

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
_PARALLEL = 1e-9
# Distance to an obstacle at which blocks are put, in m.
_GAP = 1e-6
# Writes that move a block by at most this much, in m, are rounding errors.
_SAME_PLACE = 1e-12
_Corridor = tuple[Any, Any, Any, Any]
# MuJoCo computes no bounding boxes of planes. Height fields are the ground.
_IGNORED_TYPES = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_HFIELD,
    mujoco.mjtGeom.mjGEOM_SDF,
)


@final
class Boxes:
  """Oriented bounding boxes of obstacles, in the frame of a register.

  Attributes:
    centres: `(..., boxes, 3)`, in m.
    rotations: Axes of the boxes, as columns, `(..., boxes, 3, 3)`.
    halves: Half edge lengths, `(boxes, 3)`, in m.
    is_exact: True for each obstacle that is a box itself, `(boxes,)` bool.
    low: Smallest coordinates of each box, `(..., boxes, 3)`, in m.
    high: Largest coordinates of each box, `(..., boxes, 3)`, in m.
  """

  def __init__(
      self,
      centres: np.ndarray,
      rotations: np.ndarray,
      halves: np.ndarray,
      is_exact: np.ndarray,
  ) -> None:
    self.centres = centres
    self.rotations = rotations
    self.halves = halves
    self.is_exact = is_exact
    self._extent = np.einsum('...bij,bj->...bi', np.abs(rotations), halves)
    self.low = centres - self._extent
    self.high = centres + self._extent

  @classmethod
  def none(cls) -> Self:
    """Returns no boxes."""
    none = np.zeros((0, 3))
    return cls(none, np.zeros((0, 3, 3)), none, np.zeros(0, bool))

  def only(self, mask: np.ndarray) -> 'Boxes':
    """Returns the boxes for which a mask, `(boxes,)` bool, is True."""
    return Boxes(
        self.centres[mask],
        self.rotations[mask],
        self.halves[mask],
        self.is_exact[mask],
    )

  def moved(self, displacement: np.ndarray) -> 'Boxes':
    """Returns the boxes after a displacement of each, `(..., boxes, 3)`."""
    boxes = copy.copy(self)
    boxes.centres = self.centres + displacement
    boxes.low = boxes.centres - self._extent
    boxes.high = boxes.centres + self._extent
    return boxes

  def joined(self, others: 'Boxes') -> 'Boxes':
    """Returns these boxes and others."""
    return Boxes(
        np.concatenate([self.centres, others.centres]),
        np.concatenate([self.rotations, others.rotations]),
        np.concatenate([self.halves, others.halves]),
        np.concatenate([self.is_exact, others.is_exact]),
    )

  def taken(
      self,
      position: np.ndarray,
      rotation: np.ndarray,
      half_size: float | np.ndarray,
  ) -> np.ndarray:
    """Returns the x coordinates that a block cannot have, an interval per box.

    Args:
      position: Centre of the block, `(3,)`, in m; its x coordinate is ignored.
      rotation: Axes of the block, as columns, `(3, 3)`.
      half_size: Half the edge length of a cube, or `(3,)` half edge lengths of
        a cuboid, in m.

    Returns:
      `(boxes, 2)`; from is not less than to if the block is beside the box.
    """
    number = len(self.centres)
    cube = np.broadcast_to(rotation, (number, 3, 3))
    crosses = np.cross(
        self.rotations.transpose(0, 2, 1)[:, :, np.newaxis],
        cube.transpose(0, 2, 1)[:, np.newaxis],
    ).reshape(number, 9, 3)
    # Two boxes are apart if their shadows on one of these axes are.
    separators = np.concatenate(
        [self.rotations.transpose(0, 2, 1), cube.transpose(0, 2, 1), crosses],
        axis=1,
    )
    reach = (half_size * np.abs(separators @ rotation)).sum(axis=-1)
    reach += np.einsum(
        'bsj,bj->bs', np.abs(separators @ self.rotations), self.halves
    )
    offset = self.centres.copy()
    offset[:, 1:] -= position[1:]
    middle = np.einsum('bsi,bi->bs', separators, offset)
    slope = separators[..., 0]
    is_flat = np.abs(slope) < _PARALLEL
    steep = np.where(is_flat, 1.0, slope)
    ends = np.stack([(middle - reach) / steep, (middle + reach) / steep], -1)
    ends.sort(axis=-1)
    ends[is_flat] = -np.inf, np.inf
    # Parallel edges have no cross product, which separates nothing.
    is_apart = is_flat & (np.abs(middle) >= reach) & (reach > _PARALLEL)
    ends[is_apart] = np.inf, -np.inf
    return np.stack(
        [ends[..., 0].max(axis=1), ends[..., 1].min(axis=1)], axis=-1
    )


@final
class Movers:
  """Solid mocap bodies, such as doors, in the frame of a register.

  Attributes:
    frames: The mocap bodies.
  """

  def __init__(
      self,
      model: Any,
      frames: Sequence[mjcf.Element],
      origin: np.ndarray,
      rotation: np.ndarray,
  ) -> None:
    """Finds the bodies.

    Args:
      model: Compiled model, as `physics.model`.
      frames: Mocap bodies of the model.
      origin: Position of the register's frame, `(3,)`, in m.
      rotation: Axes of that frame, as columns, `(3, 3)`.
    """
    self._origin, self._rotation = origin, rotation
    carriers = model.body_weldid[model.geom_bodyid]
    is_solid = _are_obstacles(model)
    self.frames: tuple[mjcf.Element, ...] = ()
    geoms, owners = [], []
    for frame in frames:
      body = model.name2id(frame.full_identifier, 'body')
      if found := np.flatnonzero(is_solid & (carriers == body)).tolist():
        geoms += found
        owners += [len(self.frames)] * len(found)
        self.frames += (frame,)
    self._owners = np.array(owners, int)
    self._boxes = _collected(model, geoms, [], np.zeros(3), np.eye(3))
    # Doors slide without turning, so the boxes are kept with the orientations
    # that they were turned by, as if the bodies were at the origin.
    self._turned = self._boxes
    self._turned_by: Any = None

  def at(self, positions: np.ndarray, quaternions: np.ndarray) -> Boxes:
    """Returns the boxes of the bodies.

    Args:
      positions: Positions of the bodies, `(..., bodies, 3)`, in m.
      quaternions: Their orientations, `(..., bodies, 4)`.
    """
    turned_by = quaternions.shape, quaternions.tobytes()
    if turned_by != self._turned_by:
      axes_of_bodies = self._rotation.T @ rotations.matrices(quaternions)
      turned = axes_of_bodies[..., self._owners, :, :]
      self._turned = Boxes(
          np.einsum('...bij,bj->...bi', turned, self._boxes.centres),
          turned @ self._boxes.rotations,
          self._boxes.halves,
          self._boxes.is_exact,
      )
      self._turned_by = turned_by
    places = (positions - self._origin) @ self._rotation
    return self._turned.moved(places[..., self._owners, :])


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
    self._boxes = Boxes.none()
    self._movers: Movers | None = None
    # Bounds between which no obstacle is, whatever value is written: the least
    # y and z, and the largest ones, each `(...)`; of static obstacles, and of
    # all of them. Movers rarely move, so the latter are kept with the poses
    # that they were computed from.
    self._fixed_corridor: _Corridor = (0.0, 0.0, 0.0, 0.0)
    self._corridor = self._fixed_corridor
    self._poses: Any = None
    self._origin = np.zeros(3)
    self._rotation = np.eye(3)
    self._limits = self._reach = -np.inf, np.inf
    self._sideways = 0.0

  def limit(self, low: float, high: float, sideways: float) -> None:
    """Sets the region in which undisturbed blocks are written.

    Args:
      low: Smallest x coordinate, in m.
      high: Largest x coordinate, in m.
      sideways: Largest distance from the y coordinate at rest, in m.
    """
    self._limits = self._reach = low, high
    self._sideways = sideways
    self._model = None

  def shift(self, displacement: np.ndarray) -> None:
    """Sets the displacement of that region, for registers that are moved.

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
    if self._movers is not None:
      self._follow(physics, self._movers)
    right, floor, left, ceiling = self._corridor
    _, y, z = position.T
    return (right < y) & (y < left) & (floor < z) & (z < ceiling)

  def nearest_free(
      self,
      physics: protocols.Physics,
      world: tuple[int, ...],
      position: np.ndarray,
      rotation: np.ndarray,
      before: float,
  ) -> float:
    """Returns the free x coordinate that is nearest to a wanted one, in m.

    An obstacle that the block is inside already does not count; contacts push
    the block out of it. Call `are_far` first, which finds the obstacles of a
    new model.

    Args:
      physics: One world or a batch of worlds.
      world: Index of the world, `()` for one world.
      position: Wanted position of the block in this world, `(3,)`, in m.
      rotation: Axes of the block, as columns, `(3, 3)`.
      before: Present x coordinate of the block, in m.
    """
    along = float(position[0])
    if abs(along - before) <= _SAME_PLACE:
      return along
    boxes = self._beside(self._boxes, position)
    if self._movers is not None:
      bound = physics.bind(self._movers.frames)
      moving = self._movers.at(bound.mocap_pos[world], bound.mocap_quat[world])
      moving = self._beside(moving, position)
      boxes = boxes.joined(self._without_region(moving))
    low, high = boxes.low[:, 0] - self._radius, boxes.high[:, 0] + self._radius
    if not ((low < along) & (along < high)).any():
      return along
    taken = boxes.taken(position, rotation, self._half_size)
    taken = taken[(before <= taken[:, 0]) | (taken[:, 1] <= before)]
    if not _is_taken(along, taken):
      return along
    ends = [*(taken[:, 0] - _GAP), *(taken[:, 1] + _GAP)]
    free = [
        end for end in ends if abs(end) < ENDLESS and not _is_taken(end, taken)
    ]
    return float(min(free, key=lambda end: abs(end - along), default=along))

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
    return self._origin + position @ self._rotation.T

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
    return vector @ self._rotation

  def _resolve(self, physics: protocols.Physics) -> None:
    """Finds frame and obstacles in a compiled model, and caches them."""
    model = physics.model
    body = int(physics.bind(self._body).element_id)
    frame = int(model.body_parentid[body])
    self._boxes = self._without_region(boxes_of(model, frame))
    self._origin, self._rotation = _pose_of(model, frame)
    self._fixed_corridor = self._corridor = self._corridor_beside(self._boxes)
    self._movers = self._poses = None
    if model.body_weldid[frame] != 0:
      self._origin = np.full(3, ENDLESS)
    else:
      bodies = self._body.root.root_model.find_all('body')
      frames = [b for b in bodies if getattr(b, 'mocap', None) == 'true']
      movers = Movers(model, frames, self._origin, self._rotation)
      self._movers = movers if movers.frames else None
    self._model = model

  def _follow(self, physics: protocols.Physics, movers: Movers) -> None:
    """Adapts the corridor to the present poses of movers."""
    bound = physics.bind(movers.frames)
    positions, quaternions = bound.mocap_pos, bound.mocap_quat
    poses = positions.tobytes(), quaternions.tobytes()
    if poses == self._poses:
      return
    moving = movers.at(positions, quaternions)
    right, floor, left, ceiling = self._corridor_beside(moving)
    fixed = self._fixed_corridor
    self._corridor = (
        np.maximum(right, fixed[0]),
        np.maximum(floor, fixed[1]),
        np.minimum(left, fixed[2]),
        np.minimum(ceiling, fixed[3]),
    )
    self._poses = poses

  def _corridor_beside(self, boxes: Boxes) -> _Corridor:
    """Returns the bounds of the space beside boxes; see `_fixed_corridor`."""
    low, high = boxes.low - self._radius, boxes.high + self._radius
    # The corridor has to be free only where blocks are written.
    least, most = self._reach
    is_ahead = (low[..., 0] < most) & (high[..., 0] > least)
    low, high = low[..., 1:], high[..., 1:]
    # The placement check refuses boxes in the region, so most boxes are on one
    # side of it.
    gaps = np.concatenate([self._rest[1:] - high, low - self._rest[1:]], -1)
    on_side = gaps.argmax(axis=-1)[..., np.newaxis] == np.arange(4)
    on_side &= is_ahead[..., np.newaxis]
    lower = np.where(on_side[..., :2], high, -np.inf)
    upper = np.where(on_side[..., 2:], low, np.inf)
    right, floor = lower.max(axis=-2, initial=-np.inf).T
    left, ceiling = upper.min(axis=-2, initial=np.inf).T
    return right, floor, left, ceiling

  def _beside(self, boxes: Boxes, position: np.ndarray) -> Boxes:
    """Returns the boxes that a block may hit on its way along x.

    Args:
      boxes: Boxes of one world.
      position: Position of the block, `(3,)`, in m.
    """
    low, high = boxes.low - self._radius, boxes.high + self._radius
    is_beside = (low[:, 1:] < position[1:]) & (position[1:] < high[:, 1:])
    return boxes.only(is_beside.all(axis=1))

  def _without_region(self, boxes: Boxes) -> Boxes:
    """Returns boxes without those that undisturbed blocks are in.

    The placement check refuses obstacles there. The obstacles in these boxes
    are round or hollow, and beside the blocks.
    """
    if not len(boxes.centres):
      return boxes
    margin = np.array([0.0, self._sideways, 0.0])
    taken = boxes.taken(self._rest, np.eye(3), self._half_size + margin)
    low, high = self._reach
    is_ahead = (taken[:, 0] < high) & (low < taken[:, 1])
    is_in_region = is_ahead & (taken[:, 0] < taken[:, 1])
    return boxes.only(boxes.is_exact | ~is_in_region)


def _is_taken(along: float, taken: np.ndarray) -> bool:
  return bool(((taken[:, 0] < along) & (along < taken[:, 1])).any())


def boxes_of(model: Any, frame: int) -> Boxes:
  """Returns the boxes of static, solid geoms in the frame of a body.

  Args:
    model: Compiled model, as `physics.model`.
    frame: Index of the body. If it can move, the result is empty.
  """
  if model.body_weldid[frame] != 0:
    return Boxes.none()
  is_static = model.body_weldid == 0  # Of a mocap body, its own index.
  geoms = np.flatnonzero(_are_obstacles(model) & is_static[model.geom_bodyid])
  sites = [
      site
      for site in range(model.nsite)
      if model.id2name(site, 'site').startswith(OUTSIDE)
  ]
  origin, turned = _pose_of(model, frame)
  return _collected(model, geoms.tolist(), sites, origin, turned)


def _are_obstacles(model: Any) -> np.ndarray:
  """Returns True for solid geoms that have a bounding box, `(geoms,)` bool."""
  is_solid = (model.geom_contype | model.geom_conaffinity) != 0
  return is_solid & ~np.isin(model.geom_type, _IGNORED_TYPES)


def _collected(
    model: Any,
    geoms: list[int],
    sites: list[int],
    origin: np.ndarray,
    turned: np.ndarray,
) -> Boxes:
  """Returns the boxes around geoms, and those of sites.

  Args:
    model: Compiled model.
    geoms: Indices of static geoms, or of geoms of mocap bodies.
    sites: Indices of sites that are boxes, of the same kinds of bodies.
    origin: Origin of the frame of the result, in that of the world, or of the
      mocap body that a geom belongs to, `(3,)`, in m.
    turned: Axes of the frame of the result, as columns, `(3, 3)`.
  """
  bodies = [*model.geom_bodyid[geoms], *model.site_bodyid[sites]]
  boxes = model.geom_aabb[geoms]
  positions = np.concatenate([model.geom_pos[geoms], model.site_pos[sites]])
  quaternions = np.concatenate([model.geom_quat[geoms], model.site_quat[sites]])
  middles = np.concatenate([boxes[:, :3], np.zeros((len(sites), 3))])
  halves = np.concatenate([boxes[:, 3:], model.site_size[sites]])
  centres, rotated = [], []
  for body, position, quaternion, middle in zip(
      bodies, positions, quaternions, middles, strict=True
  ):
    place, rotation = _pose_of(model, body)
    axes_of_box = rotation @ matrix(quaternion)
    centre = place + rotation @ position + axes_of_box @ middle
    centres.append(turned.T @ (centre - origin))
    rotated.append(turned.T @ axes_of_box)
  are_boxes = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX
  return Boxes(
      np.reshape(centres, (-1, 3)),
      np.reshape(rotated, (-1, 3, 3)),
      np.reshape(halves, (-1, 3)),
      np.append(are_boxes, np.ones(len(sites), bool)),
  )


def _pose_of(model: Any, body: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the position and the rotation of an immovable body.

  Those of a part of a mocap body are in the frame of that body.
  """
  position, rotation = np.zeros(3), np.eye(3)
  while body and model.body_mocapid[body] < 0:
    turn = matrix(model.body_quat[body])
    position = model.body_pos[body] + turn @ position
    rotation = turn @ rotation
    body = int(model.body_parentid[body])
  return position, rotation


def matrix(quaternion: np.ndarray) -> np.ndarray:
  """Returns the rotation matrix, `(3, 3)`, of a quaternion, `(4,)`."""
  result = np.empty(9)
  mujoco.mju_quat2Mat(result, np.asarray(quaternion, np.float64))
  return result.reshape(3, 3)

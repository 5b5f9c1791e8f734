"""Solids: what the poses of a block fill, and their distances to geoms.

All poses of a cube that moves along a line, anywhere in a region, fill an
oriented box. MuJoCo measures the distance of the box to each geom. The edges of
the box of a cube that turns are rounded. A geom that moves along a line is
measured at so many places that it cannot meet the box between them.
"""

from collections.abc import Iterable, Mapping, Sequence
import copy
import itertools
from typing import Any, NamedTuple, Self, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import proximity
from realab_suite.entities import registers

# Depth up to which solids may overlap, in m.
TOLERANCE = 1e-3
# Smallest distance by which solids that move must keep from this depth, in m.
_SLACK = 1e-4
# Largest height of a block above the surface that carries it, in m. It exceeds
# the gap under a planar block.
GAP = 0.01
# Depth in m from which on boxes are certain to overlap.
_SURE = 2 * TOLERANCE
# Half width of the box around a line of sight, in m.
SIGHT = _SURE
# Sine of the angle of lines that count as parallel.
_PARALLEL = 1e-6
# Half the size of a plane without end, in m.
_ENDLESS = 1e6
# Smallest half width of a box, in m.
_THIN = 1e-6
# Number of headings of a block that turns at which its width is measured.
_NUM_TURNS = 65
_SIDES = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
_DOWN = np.array([0.0, 0.0, -1.0])
_CARRIERS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
# MuJoCo computes no distances of these.
_UNMEASURED = mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF
# Half the size of a box inside of a geom: shares of numbers of the geom's size.
_INNER = {
    mujoco.mjtGeom.mjGEOM_BOX: ([0, 1, 2], [1.0, 1.0, 1.0]),
    mujoco.mjtGeom.mjGEOM_SPHERE: ([0, 0, 0], [3**-0.5] * 3),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: ([0, 1, 2], [3**-0.5] * 3),
    mujoco.mjtGeom.mjGEOM_CYLINDER: ([0, 0, 1], [2**-0.5, 2**-0.5, 1.0]),
}


@final
class Solid(NamedTuple):
  """A geom of a model in some pose, or a box that takes its place.

  Attributes:
    geom: Index of the geom in the model.
    centre: Its centre in the world, `(3,)`, in m.
    matrix: Its axes, as columns, `(3, 3)`.
    half: Half the edge lengths of a box around it, `(3,)`, in m.
    is_box: True if the box takes the place of the geom.
    way: Displacement of the solid to the other end of its way, `(3,)`, in m.
    radius: Radius of the upright edges of the box, in m.
    inset: Distance of the axes of these edges from the sides of the box, in m.
      It is less than the radius if a block makes less than a quarter turn.
  """

  geom: int
  centre: np.ndarray
  matrix: np.ndarray
  half: np.ndarray
  is_box: bool = False
  way: np.ndarray = np.zeros(3)
  radius: float = 0.0
  inset: float = 0.0

  @property
  def bounds(self) -> np.ndarray:
    """Low and high corner of its bounds in the world, `(2, 3)`, in m."""
    reach = np.abs(self.matrix) @ self.half
    low, high = np.minimum(self.way, 0.0), np.maximum(self.way, 0.0)
    return np.array([self.centre - reach + low, self.centre + reach + high])

  @property
  def hulls(self) -> list[tuple[Self, float]]:
    """Solids with sharp edges, each of which contains it within a margin."""
    if not self.radius:
      return [(self, 0.0)]
    core = self.half - [self.inset, self.inset, 0.0]
    return [(self, 0.0), (self._replace(half=core), self.radius)]

  @property
  def inside(self) -> np.ndarray:
    """Half the edge lengths of a box that is filled by poses, `(3,)`, in m."""
    corner = self.inset - self.radius / 2 if self.radius else 0.0
    return self.half - [corner, corner, 0.0]

  def moved(self, displacement: np.ndarray) -> Self:
    """Returns the solid at another place, `(3,)`, in m from this one."""
    return self._replace(centre=self.centre + displacement)


@final
class Region(NamedTuple):
  """The poses of a block: along a path, and anywhere in a region.

  Attributes:
    solid: Box that contains the block in all poses.
    path: Path of the block in the frame of its register.
    reach: Half-widths of the positions of its centre, `(3,)`, in m.
    half_size: Half the edge length of the block, in m.
    frame: Axes of the register in the world, as columns, `(3, 3)`.
  """

  solid: Solid
  path: registers.Path
  reach: np.ndarray
  half_size: float
  frame: np.ndarray

  def moved(self, displacement: np.ndarray) -> Self:
    """Returns the region moved by a vector in its frame, `(3,)`, in m."""
    there = self.solid.moved(self.frame @ displacement)
    return self._replace(solid=there)

  def corners(self) -> np.ndarray:
    """Returns the extreme positions of the centre, `(8, 3)`, in m."""
    return self.solid.centre + (_SIDES * self.reach) @ self.solid.matrix.T

  def describe(self, point: np.ndarray) -> str:
    """Returns the pose of the block nearest to a point, `(3,)`, as text."""
    if self.path.is_sight:
      at = ', '.join(f'{x:.3g}' for x in point)
      return f'would see its tile {self.path.block} through ({at})'
    _, centre, matrix, *_ = self.solid
    nearest = np.clip((point - centre) @ matrix, -self.reach, self.reach)
    x, y, _ = centre + matrix @ nearest
    first, last = self.path.values
    line = self.path.last - self.path.first
    if line.any():
      share = np.clip(0.5 + nearest @ line / (line @ line), 0.0, 1.0)
      first = last = first + share * (last - first)
    value = f'value {first:g}'
    if first != last:
      value = f'values {first:g} to {last:g}'
    return f'at {value} would be at ({x:.3g}, {y:.3g})'


def regions(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> list[Region]:
  """Returns all poses that writes can give the blocks of a register.

  Args:
    physics: Physics of one world, in which the register stands where it is; the
      blocks are moved.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  return _regions(physics, register, spread, register.footprint(physics))


def initial_regions(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> list[Region]:
  """Returns the poses in which the blocks of a register begin an episode.

  Args:
    physics: Physics of one world, in which the register has just been settled.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  # Episodes begin with the same value in all ports.
  value = float(np.ravel(register.applied(physics))[0])
  paths = []
  for i, block in enumerate(register.blocks):
    centre, heading = np.array(block.position(physics)), block.heading(physics)
    paths.append(
        registers.Path(i, centre, centre, (value,) * 2, (float(heading),) * 2)
    )
  return _regions(physics, register, spread, paths)


def _regions(
    physics: Any,
    register: registers.Register,
    spread: np.ndarray,
    paths: Sequence[registers.Path],
) -> list[Region]:
  """Returns the regions of paths of the blocks of a register."""
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  origin, matrix = np.array(frame.xpos), np.reshape(frame.xmat, (3, 3)).copy()
  geoms = [int(physics.bind(b.geom).element_id) for b in register.blocks]
  found = []
  for path in paths:
    centre = origin + matrix @ (path.first + path.last) / 2
    if path.is_sight:
      way = matrix @ (path.last - path.first)
      axes, _ = np.linalg.qr(np.column_stack([way, matrix[:, :2]]))
      axes[:, 2] *= np.linalg.det(axes)
      reach = np.abs(axes.T @ (matrix[:, :2] * spread)).sum(axis=1) + SIGHT
      reach[0] += np.linalg.norm(way) / 2
      solid = Solid(geoms[path.block], centre, axes, reach, is_box=True)
      found.append(Region(solid, path, reach, 0.0, matrix))
      continue
    size = register.blocks[path.block].half_size
    # The width is the same after each quarter turn.
    first, last = path.headings
    turn = np.clip(last - first, -np.pi / 2, np.pi / 2)
    turns = first + np.linspace(0.0, turn, _NUM_TURNS)
    width = size * (np.abs(np.cos(turns)) + np.abs(np.sin(turns))).max()
    reach = np.abs(path.last - path.first) / 2 + [*spread, 0.0]
    solid = Solid(
        geoms[path.block],
        centre,
        matrix,
        reach + np.array([width, width, size]),
        is_box=True,
        radius=np.sqrt(2.0) * size if turn else 0.0,
        inset=width,
    )
    found.append(Region(solid, path, reach, size, matrix))
  return found


def owners(
    physics: Any, named: Mapping[str, registers.Register]
) -> dict[int, str]:
  """Returns the names of registers by the geoms of the bodies of blocks."""
  bodies = physics.model.geom_bodyid
  return {
      geom: name
      for name, register in named.items()
      for block in register.blocks
      for geom in np.flatnonzero(
          bodies == bodies[physics.bind(block.geom).element_id]
      ).tolist()
  }


def settle(physics: Any, named: Iterable[registers.Register]) -> None:
  """Resets a world and puts registers into the middle of their regions."""
  mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
  physics.mark_as_dirty()
  for register in named:
    register.settle(physics, np.zeros(2), is_initialized=False)
  mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)


@final
class Space:
  """Solids of a compiled model. It works on a copy of the model.

  Attributes:
    is_fixed: True for geoms that nothing can push, `(geoms,)` bool. Mocap
      bodies such as doors move, but cannot be pushed.
  """

  def __init__(self, model: mujoco.MjModel) -> None:
    """Copies a compiled model."""
    bodies = model.body_weldid[model.geom_bodyid]
    self._is_solid = (model.geom_contype | model.geom_conaffinity) != 0
    self.is_fixed = (bodies == 0) | (model.body_mocapid[bodies] >= 0)
    # Half the size of a box around each geom, with the same centre.
    self._half = np.abs(model.geom_aabb[:, :3]) + model.geom_aabb[:, 3:]
    self._model = model = copy.copy(model)
    # MuJoCo does not detect a capsule that passes entirely through a box.
    is_capsule = model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    model.geom_type[is_capsule] = mujoco.mjtGeom.mjGEOM_CYLINDER
    model.geom_size[is_capsule, 1] += model.geom_size[is_capsule, 0]
    # Rays find what stays in place, whether it is visible or not.
    model.geom_group[:] = np.where(self._is_solid & (bodies == 0), 0, 1)
    model.geom_rgba[:, 3] = 1.0
    model.geom_matid[:] = -1
    self._data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, self._data)

  def solid(self, geom: int, centre: Any, matrix: Any) -> Solid:
    """Returns a geom in a pose; see `Solid`."""
    matrix = np.reshape(matrix, (3, 3)).copy()
    return Solid(geom, np.array(centre), matrix, self._half[geom])

  def solids(self, physics: Any, mask: np.ndarray) -> list[Solid]:
    """Returns the solid geoms of a mask in their present poses.

    Height fields are not among them.

    Args:
      physics: Physics of one world, with derived quantities.
      mask: True for geoms to return, `(geoms,)` bool.
    """
    data = physics.data
    mask = mask & self._is_solid
    mask &= ~np.isin(self._model.geom_type, _UNMEASURED)
    return [
        self.solid(geom, data.geom_xpos[geom], data.geom_xmat[geom])
        for geom in np.flatnonzero(mask).tolist()
    ]

  def solids_of(self, physics: Any, model: mjcf.RootElement) -> list[Solid]:
    """Returns the solid geoms of an entity in their present poses."""
    mask = np.zeros_like(self._is_solid)
    for geom in model.find_all('geom'):
      mask[physics.bind(geom).element_id] = True
    return self.solids(physics, mask)

  def name(self, geom: int) -> str:
    """Returns the name of a geom, for messages."""
    return self._model.geom(geom).name or f'geom {geom}'

  def meet(
      self, one: Solid, other: Solid, clearance: float = 0.0
  ) -> np.ndarray | None:
    """Returns a point where two solids meet, `(3,)`, or `None`.

    Args:
      one: A solid that stays where it is.
      other: Another one, of another geom; it may move along its way.
      clearance: Smallest distance that they may have, in m. They may overlap by
        `TOLERANCE` if it is 0.
    """
    length, done = float(np.linalg.norm(other.way)), 0.0
    direction = other.way / (length or 1.0)
    least = _SLACK if length else 0.0
    while True:
      there = other.moved(done * direction)
      distance, point = self._distance(one, there, clearance + length)
      # How far it can move, in any direction, before they meet.
      slack = distance - clearance + TOLERANCE
      if slack < least:
        return point
      if done >= length:
        return None
      done = min(done + slack, length)

  def _distance(
      self, one: Solid, other: Solid, limit: float
  ) -> tuple[float, np.ndarray]:
    """Returns the distance of two solids and the point between them.

    Args:
      one: A solid.
      other: Another one, of another geom.
      limit: Distance, in m, above which the result may be any larger number.
    """
    found = -np.inf, one.centre
    for (hull, margin), (around, beyond) in itertools.product(
        one.hulls, other.hulls
    ):
      width = margin + beyond
      distance, point = self._measure(hull, around, limit + width)
      if distance - width > found[0]:
        found = distance - width, point
      if found[0] > limit:
        break
    return found

  def _measure(
      self, one: Solid, other: Solid, limit: float
  ) -> tuple[float, np.ndarray]:
    """Returns the distance of two solids, with sharp edges; or -inf."""
    for solid in (one, other):
      if solid.is_box:
        self._model.geom_type[solid.geom] = mujoco.mjtGeom.mjGEOM_BOX
        self._model.geom_size[solid.geom] = np.maximum(solid.half, _THIN)
    distance, point = proximity.distance(
        self._model, self._data, (one.geom, other.geom),
        (one.centre, other.centre), (one.matrix.ravel(), other.matrix.ravel()),
        limit + TOLERANCE,
    )  # fmt: skip
    # A distance that MuJoCo cannot compute counts as an overlap.
    return distance or -np.inf, point

  def is_surely_met(
      self, one: Solid, other: Solid, shifts: np.ndarray
  ) -> np.ndarray:
    """Returns True where a box, moved, certainly meets a solid.

    It compares boxes and planes, for many places at once. Where it is False,
    only `meet` can tell.

    Args:
      one: A solid that is a box.
      other: Another one that stays where it is.
      shifts: Displacements of the first one, `(shifts, 3)`, in m.

    Returns:
      `(shifts,)` bool.
    """
    kind = mujoco.mjtGeom(self._model.geom_type[other.geom])
    boxes = one.matrix * one.inside
    offsets = one.centre + shifts - other.centre
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
      normal = other.matrix[:, 2]
      return offsets @ normal - np.abs(normal @ boxes).sum() < -_SURE
    if other.is_box:
      half = other.inside
    elif kind in _INNER:
      numbers, shares = _INNER[kind]
      half = self._model.geom_size[other.geom][numbers] * shares
    else:
      return np.zeros(len(shifts), bool)
    others = other.matrix * half
    # Boxes meet if no axis of a face, and none across two edges, is between.
    across = np.cross(one.matrix.T[:, np.newaxis], other.matrix.T).reshape(
        -1, 3
    )
    lengths = np.linalg.norm(across, axis=1)
    is_axis = lengths > _PARALLEL
    across = across[is_axis] / lengths[is_axis, np.newaxis]
    axes = np.concatenate([one.matrix.T, other.matrix.T, across])
    reach = np.abs(axes @ boxes).sum(axis=1) + np.abs(axes @ others).sum(axis=1)
    return (np.abs(offsets @ axes.T) < reach - _SURE).all(axis=1)

  def may_carry(self, points: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Returns True where one geom that stays may be under all of some points.

    Where it is True, only `uncarried` can tell.

    Args:
      points: Positions, `(points, 3)`, in m.
      shifts: Displacements of the points, `(shifts, 3)`, in m.

    Returns:
      `(shifts,)` bool.
    """
    model = self._model
    found = np.zeros(len(shifts), bool)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    for geom in np.flatnonzero(model.geom_group == 0).tolist():
      half = self._half[geom]
      if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        # A plane without a size has no end.
        size = model.geom_size[geom]
        half = np.where(size > 0.0, size, _ENDLESS)
      matrix = np.reshape(self._data.geom_xmat[geom], (3, 3))
      reach = (np.abs(matrix) @ half)[:2]
      centre = self._data.geom_xpos[geom, :2]
      is_within = low + shifts[:, :2] >= centre - reach
      is_within &= high + shifts[:, :2] <= centre + reach
      found |= is_within.all(axis=1)
    return found

  def uncarried(self, points: np.ndarray, depth: float) -> np.ndarray | None:
    """Returns the first of some points that is not over the same surface.

    A set of positions is over a convex surface if its extreme ones are, so that
    no positions between them have to be sampled.

    Args:
      points: Extreme positions, `(points, 3)`, in m.
      depth: Largest distance of the surface below the points, in m.

    Returns:
      The point, `(3,)`; `None` if one geom that stays in place is under all.
    """
    first, geom = None, np.array([-1], np.int32)
    for point in points:
      distance = mujoco.mj_ray(
          self._model, self._data, point, _DOWN, _CARRIERS, 1, -1, geom, None
      )
      first = int(geom[0]) if first is None else first
      if not 0.0 <= distance <= depth or geom[0] != first:
        return np.array(point)
    return None


@final
class Crowd:
  """Solids, with a fast search for those that meet another one."""

  def __init__(self, space: Space, members: Iterable[Solid] = ()) -> None:
    """Initializes the crowd.

    Args:
      space: Space of the solids.
      members: The solids.
    """
    self._space = space
    self._members = list(members)
    self._bounds = np.reshape([m.bounds for m in self._members], (-1, 2, 3))

  def joined(self, others: Iterable[Solid]) -> 'Crowd':
    """Returns a crowd of these solids and others."""
    joined, added = copy.copy(self), Crowd(self._space, others)
    joined._members = self._members + added._members
    joined._bounds = np.concatenate([self._bounds, added._bounds])
    return joined

  def is_surely_met(self, solid: Solid, shifts: np.ndarray) -> np.ndarray:
    """Returns True where a box, moved, certainly meets a member.

    Args:
      solid: The box.
      shifts: Its displacements, `(shifts, 3)`, in m.

    Returns:
      `(shifts,)` bool; where it is False, only `meeting` can tell.
    """
    found = np.zeros(len(shifts), bool)
    low, high = solid.bounds
    for member, bounds in zip(self._members, self._bounds, strict=True):
      is_near = (bounds[0] <= high + shifts) & (low + shifts <= bounds[1])
      rest = np.flatnonzero(is_near.all(axis=1) & ~found)
      if rest.size:
        found[rest] = self._space.is_surely_met(solid, member, shifts[rest])
    return found

  def meeting(
      self, solid: Solid, clearance: float = 0.0
  ) -> tuple[Solid, np.ndarray] | None:
    """Returns a member that meets a solid, and the point, `(3,)`, or `None`.

    Args:
      solid: The solid.
      clearance: Smallest distance that they may have, in m.
    """
    low, high = solid.bounds
    is_near = (self._bounds[:, 0] <= high + clearance).all(axis=1)
    is_near &= (low - clearance <= self._bounds[:, 1]).all(axis=1)
    for i in np.flatnonzero(is_near).tolist():
      point = self._space.meet(solid, self._members[i], clearance)
      if point is not None:
        return self._members[i], point
    return None

"""Clearances: which blocks are inside something, as MuJoCo measures it.

A register is posed along the path on which values move its blocks, in steps of
at most half an edge length. Consecutive poses overlap, so nothing that is
deeper inside the path than the tolerance is between them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
import copy
import itertools
from typing import Any, NamedTuple, Self, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import proximity
from realab_suite.entities import registers
from realab_suite.entities import rotations

# Depth up to which a block may be inside something, in m.
TOLERANCE = 1e-3
# Largest height of a block above the surface that carries it, in m. It exceeds
# the gap under a planar block.
GAP = 0.01
# Least number of values at which a register is posed, and the number of times
# that the steps between them may be halved.
_NUM_VALUES, _NUM_HALVINGS = 17, 7
# Largest turn of a block from one pose to the next, in rad: its corners are
# then less than the tolerance beyond both poses.
_TURN = 0.2
_ROUNDING = 1e-9
# Half the extent of planes, in m.
_ENDLESS = 1e6
_SIDES = np.array(list(itertools.product([-1.0, 1.0], [-1.0, 1.0], [0.0])))
_DOWN = np.array([0.0, 0.0, -1.0])
_CARRIERS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
# Uneven ground, of which MuJoCo measures no distances.
_GROUND = mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF


@final
class Shapes(NamedTuple):
  """Geoms in some poses, or boxes that take their places.

  Attributes:
    geoms: Index of each geom in the model, `(shapes,)`.
    centres: Their centres in the world, `(shapes, 3)`, in m.
    axes: Their axes, as columns, `(shapes, 3, 3)`.
    halves: Half the edge lengths of boxes around them, `(shapes, 3)`, in m.
    reach: Half-widths of the region of each centre, along the axes of the
      shape, `(shapes, 3)`, in m; the box is larger by this.
    names: Names of the registers, or else of the geoms, `(shapes,)`.
    values: Values of the register, as text, `(shapes,)`; '' for other geoms.
    is_box: True if the box takes the place of the geom, `(shapes,)`.
  """

  geoms: np.ndarray
  centres: np.ndarray
  axes: np.ndarray
  halves: np.ndarray
  reach: np.ndarray
  names: np.ndarray
  values: np.ndarray
  is_box: np.ndarray

  @property
  def bounds(self) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corners in the world, each `(shapes, 3)`, in m."""
    extent = np.einsum('nij,nj->ni', np.abs(self.axes), self.halves)
    return self.centres - extent, self.centres + extent

  @property
  def corners(self) -> np.ndarray:
    """Extreme positions of the centres, `(shapes, 4, 3)`, in m."""
    offsets = _SIDES * self.reach[:, np.newaxis]
    turned = np.einsum('nij,nkj->nki', self.axes, offsets)
    return self.centres[:, np.newaxis] + turned

  def moved(self, displacement: np.ndarray) -> Self:
    """Returns the shapes at other places, `(3,)` or `(shapes, 3)`, in m."""
    return self._replace(centres=self.centres + displacement)

  def only(self, mask: Any) -> Self:
    """Returns the shapes of a mask, `(shapes,)` bool, or of some indices."""
    return type(self)(*(array[mask] for array in self))

  def describe(self, index: int, place: Any = None) -> str:
    """Returns the value and the position of a shape, as text.

    Args:
      index: Index of the shape.
      place: Position of its centre, `(x, y)`, in m; `None` for the middle of
        its region.
    """
    x, y = self.centres[index, :2] if place is None else place
    return f'at value {self.values[index]} would be at ({x:.3g}, {y:.3g})'


def joined(parts: Sequence[Shapes]) -> Shapes:
  """Returns the shapes of all parts, of which there is at least one."""
  return Shapes(*map(np.concatenate, zip(*parts, strict=True)))


def poses(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> Shapes:
  """Returns the blocks of a register along its path, and moves them.

  With ports, all of them get the same value; and each of them gets all values,
  while the others have the lowest or the highest one.

  Args:
    physics: Physics of one world, in which the register has been settled.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  low, high = (np.full(register.value_spec.shape, x)
               for x in register.value_range)  # fmt: skip
  ways = [(low, high)]
  for i, ends in itertools.product(range(low.size), (low, high)):
    if register.PORTS:
      is_moved = np.arange(low.size) == i
      ways.append(
          (np.where(is_moved, low, ends), np.where(is_moved, high, ends))
      )
  halves = np.array([block.half_size for block in register.blocks])
  values: list[Any] = []
  tracks: list[np.ndarray] = []
  for first, last in ways:
    for value, track in _along(physics, register, halves, first, last):
      values.append(_text(value))
      tracks.append(track)
  return _shapes(
      physics, register, spread, np.array(values, object), np.array(tracks)
  )


def initial_pose(
    physics: Any, register: registers.Register, spread: np.ndarray
) -> Shapes:
  """Returns the blocks of a register as an episode begins with them.

  Args:
    physics: Physics of one world, in which the register has been settled.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  value = np.array([_text(register.applied(physics))], object)
  track = _track(physics, register)
  return _shapes(physics, register, spread, value, track[np.newaxis])


def _along(
    physics: Any,
    register: registers.Register,
    halves: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
) -> list[tuple[np.ndarray, np.ndarray]]:
  """Returns values from first to last, and the tracks of the blocks there."""

  def pose(share: float) -> tuple[np.ndarray, np.ndarray]:
    value = np.clip(first + share * (last - first), first, last)
    register.pose(physics, value)
    return value, _track(physics, register)

  shares = np.linspace(0.0, 1.0, _NUM_VALUES).tolist()
  poses_by_share = {share: pose(share) for share in shares}
  for _ in range(_NUM_HALVINGS):
    steps = np.diff([poses_by_share[share][1] for share in shares], axis=0)
    turns = np.abs(np.remainder(steps[..., 3] + np.pi, 2 * np.pi) - np.pi)
    is_long = np.linalg.norm(steps[..., :3], axis=-1) > halves + _ROUNDING
    is_long |= turns > _TURN
    middles = [(shares[i] + shares[i + 1]) / 2
               for i in np.flatnonzero(is_long.any(axis=-1))]  # fmt: skip
    poses_by_share |= {share: pose(share) for share in middles}
    shares = sorted(poses_by_share)
  return [poses_by_share[share] for share in shares]


def _text(value: np.ndarray) -> str:
  """Returns a value, `(...)` or `(..., ports)`, as text."""
  return ', '.join(f'{number:g}' for number in np.ravel(value))


def _track(physics: Any, register: registers.Register) -> np.ndarray:
  """Returns position and heading of each block, `(blocks, 4)`."""
  return np.array([
      [*block.position(physics), block.heading(physics)]
      for block in register.blocks
  ])  # fmt: skip


def _shapes(
    physics: Any,
    register: registers.Register,
    spread: np.ndarray,
    values: np.ndarray,
    tracks: np.ndarray,
) -> Shapes:
  """Returns the different poses of the blocks of a register.

  In a region, a turned block counts as an upright box around it.

  Args:
    physics: Physics of one world.
    register: The register.
    spread: Half-widths of the region, `(2,)`, in m.
    values: Values, as text, `(values,)`.
    tracks: Positions and headings in the frame of the register,
      `(values, blocks, 4)`.
  """
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  origin, axes = np.array(frame.xpos), np.reshape(frame.xmat, (3, 3)).copy()
  parts = []
  for i, block in enumerate(register.blocks):
    _, first = np.unique(tracks[:, i].round(9), axis=0, return_index=True)
    first.sort()
    track = tracks[first, i]
    size, number = block.half_size, len(track)
    half = np.full((number, 3), size)
    reach = np.tile([*spread, 0.0], (number, 1))
    turned = rotations.matrices(rotations.quaternion_of(track[:, 3]))
    if spread.any():
      half[:, :2] *= np.abs(turned[:, 0, :2]).sum(axis=-1, keepdims=True)
      turned = np.eye(3)
    parts.append(
        Shapes(
            np.full(number, int(physics.bind(block.geom).element_id)),
            origin + track[:, :3] @ axes.T,
            np.broadcast_to(axes @ turned, (number, 3, 3)),
            half + reach,
            reach,
            np.full(number, register.name, object),
            values[first],
            np.ones(number, bool),
        )
    )
  return joined(parts)


def owners(
    physics: Any, named: Mapping[str, registers.Register]
) -> dict[int, str]:
  """Returns the names of registers by the geoms that move with their blocks."""
  parents, bodies = physics.model.body_parentid, physics.model.geom_bodyid
  owner_of_body = {
      int(bodies[physics.bind(block.geom).element_id]): name
      for name, register in named.items()
      for block in register.blocks
  }
  for body, parent in enumerate(parents):  # Parents come first.
    if int(parent) in owner_of_body:
      owner_of_body.setdefault(body, owner_of_body[int(parent)])
  return {
      geom: owner_of_body[int(body)]
      for geom, body in enumerate(bodies)
      if int(body) in owner_of_body
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
  """A copy of a compiled model, in which distances are measured.

  Attributes:
    is_fixed: True for geoms that nothing can push, `(geoms,)` bool. Mocap
      bodies such as doors move, but cannot be pushed.
    is_plane: True for planes, `(geoms,)` bool.
  """

  def __init__(self, model: mujoco.MjModel) -> None:
    """Copies a compiled model."""
    bodies = model.body_weldid[model.geom_bodyid]
    is_solid = (model.geom_contype | model.geom_conaffinity) != 0
    self.is_fixed = (bodies == 0) | (model.body_mocapid[bodies] >= 0)
    self.is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    self._is_measured = is_solid & ~np.isin(model.geom_type, _GROUND)
    self._half = np.abs(model.geom_aabb[:, :3]) + model.geom_aabb[:, 3:]
    self._half[self.is_plane] = _ENDLESS
    names = (model.geom(i).name or f'geom {i}' for i in range(model.ngeom))
    self._names = np.array([*names], object)
    self._model = model = copy.copy(model)
    # Rays find what stays in place, whether it is visible or not.
    model.geom_group[:] = np.where(is_solid & (bodies == 0), 0, 1)
    model.geom_rgba[:, 3] = 1.0
    model.geom_matid[:] = -1
    self._data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, self._data)

  def shapes(self, data: Any, mask: np.ndarray) -> Shapes:
    """Returns solid geoms in their present poses.

    Uneven ground is not among them.

    Args:
      data: Data of one world, with derived quantities.
      mask: True for geoms to return, `(geoms,)` bool.
    """
    geoms = np.flatnonzero(mask & self._is_measured)
    return Shapes(
        geoms,
        data.geom_xpos[geoms],
        np.reshape(data.geom_xmat[geoms], (-1, 3, 3)),
        self._half[geoms],
        np.zeros((len(geoms), 3)),
        self._names[geoms],
        np.full(len(geoms), '', object),
        np.zeros(len(geoms), bool),
    )

  def at(self, state: np.ndarray) -> mujoco.MjData:
    """Returns the data of the copy in an integration state, `(size,)`.

    Poses of geoms are those of another state until `update`.
    """
    mujoco.mj_setState(
        self._model, self._data, state, mujoco.mjtState.mjSTATE_INTEGRATION
    )
    return self._data

  def update(self) -> None:
    """Computes the poses of geoms in the state of the copy."""
    mujoco.mj_kinematics(self._model, self._data)

  def meetings(
      self, blocks: Shapes, others: Shapes
  ) -> Iterator[tuple[int, int]]:
    """Yields the indices of each block and each other shape inside it."""
    low, high = blocks.bounds
    other_low, other_high = others.bounds
    is_near = (low[:, np.newaxis] < other_high - TOLERANCE).all(axis=-1)
    is_near &= (high[:, np.newaxis] > other_low + TOLERANCE).all(axis=-1)
    model = self._model
    geoms, other_geoms = blocks.geoms[:, np.newaxis], others.geoms
    is_near &= (
        (model.geom_contype[geoms] & model.geom_conaffinity[other_geoms])
        | (model.geom_contype[other_geoms] & model.geom_conaffinity[geoms])
    ) != 0
    for i, j in np.argwhere(is_near).tolist():
      if self.distance(blocks, i, others, j, 0.0) < -TOLERANCE:
        yield i, j

  def distance(
      self, ones: Shapes, i: int, others: Shapes, j: int, limit: float
  ) -> float:
    """Returns the distance of two shapes, in m; below 0 for an overlap.

    Args:
      ones: Some shapes.
      i: Index of one of them.
      others: Other shapes.
      j: Index of one of these.
      limit: Distance, in m, above which the result may be any larger number.
    """
    pair = (ones, i), (others, j)
    geoms = [shapes.geoms[index] for shapes, index in pair]
    if geoms[0] == geoms[1]:  # A block of the world in two registers.
      return -np.inf
    for shapes, index in pair:
      if shapes.is_box[index]:
        geom = shapes.geoms[index]
        self._model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_BOX
        self._model.geom_size[geom] = shapes.halves[index]
    distance, _ = proximity.distance(
        self._model, self._data, geoms,
        [shapes.centres[index] for shapes, index in pair],
        [shapes.axes[index].ravel() for shapes, index in pair],
        limit + GAP,
    )  # fmt: skip
    return distance

  def uncarried(self, points: np.ndarray, depth: float) -> int | None:
    """Returns the first of some points that is not over the same surface.

    Args:
      points: Positions, `(points, 3)`, in m.
      depth: Largest distance of the surface below the points, in m.

    Returns:
      Index of the point; `None` if one geom that stays in place is under all.
    """
    first, geom = None, np.array([-1], np.int32)
    for i, point in enumerate(points):
      distance = mujoco.mj_ray(
          self._model, self._data, point, _DOWN, _CARRIERS, 1, -1, geom, None
      )
      first = int(geom[0]) if first is None else first
      if not 0.0 <= distance <= depth or geom[0] != first:
        return i
    return None

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

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.engine import batch_physics
from realab_suite.entities import proximity
from realab_suite.entities import registers
from realab_suite.entities import rotations

# Depth up to which a block may be inside something, in m.
TOLERANCE = 1e-3
# Largest height of a block above the surface that carries it, in m. It exceeds
# the gap under a planar block.
GAP = 0.01
# Number of values at which a register is posed at once, and the number of times
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
    values: Value of the register, `()` or `(ports,)`, as object `(shapes,)`;
      `None` for other geoms.
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
    return type(self)(*[array[mask] for array in self])

  def describe(self, index: int, place: Any = None) -> str:
    """Returns the value and the position of a shape, as text.

    Args:
      index: Index of the shape.
      place: Position of its centre, `(x, y)`, in m; `None` for the middle of
        its region.
    """
    x, y = self.centres[index, :2] if place is None else place
    value = ', '.join(f'{number:g}' for number in np.ravel(self.values[index]))
    return f'at value {value} would be at ({x:.3g}, {y:.3g})'


@final
class Survey(NamedTuple):
  """Where geoms and registers are in a world, once registers have settled.

  Attributes:
    space: Copy of the compiled model.
    owners: Names of registers by the geoms that move with their blocks.
    solids: All solid geoms, except uneven ground.
    paths: Blocks of each register along its path, by its name.
    starts: Blocks of each register as an episode begins with them.
  """

  space: 'Space'
  owners: dict[int, str]
  solids: Shapes
  paths: dict[str, Shapes]
  starts: dict[str, Shapes]

  def others(self, mask: np.ndarray) -> np.ndarray:
    """Returns a mask, `(geoms,)` bool, without the geoms of registers."""
    mask = mask.copy()
    mask[list(self.owners)] = False
    return mask

  def select(self, mask: np.ndarray) -> Shapes:
    """Returns the solid geoms of a mask, `(geoms,)` bool."""
    return self.solids.only(mask[self.solids.geoms])


def joined(parts: Sequence[Shapes]) -> Shapes:
  """Returns the shapes of all parts, of which there is at least one."""
  return Shapes(*map(np.concatenate, zip(*parts, strict=True)))


def survey(
    physics: Any,
    named: Mapping[str, registers.Register],
    is_spread: bool = False,
) -> 'Survey':
  """Returns where geoms are in a world, and registers along their paths.

  With ports, all of them get the same value; and each of them gets all values,
  while the others have the lowest or the highest one.

  Args:
    physics: Physics of one world, with derived quantities, in which the
      registers have been settled.
    named: The registers, by name.
    is_spread: True for the blocks in the whole region of each register's
      positions, False for those in its middle.

  Raises:
    SpecError: If a register cannot be posed at several values at once.
  """
  space = Space(physics.model.ptr)
  named = {name: one for name, one in named.items() if one.blocks}
  paths, starts = {}, {}
  if named:
    # Each world of a batch poses a register at another value.
    worlds = batch_physics.BatchPhysics(physics, _NUM_VALUES, num_threads=1)
    mujoco.mj_getState(
        physics.model.ptr,
        physics.data.ptr,
        worlds.state[0],
        mujoco.mjtState.mjSTATE_INTEGRATION,
    )
    worlds.state[1:] = worlds.state[0]
    for name, register in named.items():
      spread = register.spread.tolist() if is_spread else (0.0, 0.0)
      starts[name] = start(physics, register, spread)
      along = _along(worlds, register)
      paths[name] = _shapes(physics, register, spread, *along)
    worlds.free()
  everything = np.ones_like(space.is_fixed)
  return Survey(
      space,
      owners(physics, named),
      space.shapes(physics.data, everything),
      paths,
      starts,
  )


def start(
    physics: Any,
    register: registers.Register,
    spread: Sequence[float] = (0.0, 0.0),
) -> Shapes:
  """Returns the blocks of a register as an episode begins with them.

  Args:
    physics: Physics of one world, in which the register has been settled.
    register: The register.
    spread: Half-widths of the region of its positions, `(2,)`, in m.
  """
  value, track = register.applied(physics), _track(physics, register)
  return _shapes(
      physics, register, spread, value[np.newaxis], track[np.newaxis]
  )


def _along(
    worlds: batch_physics.BatchPhysics, register: registers.Register
) -> tuple[np.ndarray, np.ndarray]:
  """Returns values of a register, and the tracks of its blocks there.

  Args:
    worlds: As many worlds as there are values at least.
    register: The register, which is moved in all worlds.

  Returns:
    The values, `(values, ...)`, and positions and headings of the blocks,
    `(values, blocks, 4)`.
  """
  shape = register.value_spec.shape
  low, high = [np.full(shape, bound) for bound in register.value_range]
  ways = [(low, high)]
  for i, ends in itertools.product(range(low.size), (low, high)):
    if register.PORTS:
      is_moved = np.arange(low.size) == i
      ways.append(
          (np.where(is_moved, low, ends), np.where(is_moved, high, ends))
      )
  halves = np.array([block.half_size for block in register.blocks])
  parts = []
  for first, last in ways:
    shares = np.linspace(0.0, 1.0, _NUM_VALUES)
    values, tracks = _pose(worlds, register, first, last, shares)
    for _ in range(_NUM_HALVINGS):
      is_long = _is_long(tracks, halves)
      if not is_long.any():
        break
      middles = (shares[:-1] + shares[1:])[is_long] / 2
      halved = _pose(worlds, register, first, last, middles)
      after = np.flatnonzero(is_long) + 1
      shares = np.insert(shares, after, middles)
      values = np.insert(values, after, halved[0], axis=0)
      tracks = np.insert(tracks, after, halved[1], axis=0)
    parts.append((values, tracks))
  values, tracks = map(np.concatenate, zip(*parts, strict=True))
  return values, tracks


def _pose(
    worlds: batch_physics.BatchPhysics,
    register: registers.Register,
    first: np.ndarray,
    last: np.ndarray,
    shares: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns values at shares of a way, `(shares,)`, and the tracks there."""
  weights = np.reshape(shares, (-1, *[1] * first.ndim))
  values = np.clip(first + weights * (last - first), first, last)
  tracks = []
  for start in range(0, len(values), _NUM_VALUES):
    part = values[start : start + _NUM_VALUES]
    try:
      register.pose(worlds, np.resize(part, (_NUM_VALUES, *first.shape)))
      track = _track(worlds, register)
    except (IndexError, TypeError, ValueError) as error:
      kind = type(register).__name__
      raise errors.SpecError(
          f'register {register.name!r}: {kind} cannot be posed at several'
          f' values at once: {messages.exception(error)}; its methods must'
          ' accept values `(...)`, of one world or of a batch'
      ) from error
    tracks.append(track[: len(part)])
  return values, np.concatenate(tracks)


def _is_long(tracks: np.ndarray, halves: np.ndarray) -> np.ndarray:
  """Returns True for steps after which poses may not overlap, `(steps,)`."""
  steps = np.diff(tracks, axis=0)
  turns = np.abs(np.remainder(steps[..., 3] + np.pi, 2 * np.pi) - np.pi)
  is_long = np.linalg.norm(steps[..., :3], axis=-1) > halves + _ROUNDING
  is_long |= turns > _TURN
  result: np.ndarray = is_long.any(axis=-1)
  return result


def _track(physics: Any, register: registers.Register) -> np.ndarray:
  """Returns position and heading of each block, `(..., blocks, 4)`."""
  tracks = [
      np.concatenate(
          [block.position(physics), block.heading(physics)[..., np.newaxis]],
          axis=-1,
      )
      for block in register.blocks
  ]
  return np.stack(tracks, axis=-2)


def _geoms(physics: Any, register: registers.Register) -> np.ndarray:
  """Returns the index of the geom of each block, `(blocks,)`."""
  geoms = [block.geom for block in register.blocks]
  indices: np.ndarray = physics.bind(geoms).element_id
  return indices


def _shapes(
    physics: Any,
    register: registers.Register,
    spread: Sequence[float],
    values: np.ndarray,
    tracks: np.ndarray,
) -> Shapes:
  """Returns the different poses of the blocks of a register.

  In a region, a turned block counts as an upright box around it.

  Args:
    physics: Physics of one world.
    register: The register.
    spread: Half-widths of the region, `(2,)`, in m.
    values: Values, `(values,)` or `(values, ports)`.
    tracks: Positions and headings in the frame of the register,
      `(values, blocks, 4)`.
  """
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  origin, axes = np.array(frame.xpos), np.reshape(frame.xmat, (3, 3)).copy()
  geoms = _geoms(physics, register)
  parts = []
  for i, block in enumerate(register.blocks):
    _, first = np.unique(tracks[:, i].round(9), axis=0, return_index=True)
    first.sort()
    track = tracks[first, i]
    size, number = block.half_size, len(track)
    half = np.full((number, 3), size)
    reach = np.tile([*spread, 0.0], (number, 1))
    turned = rotations.matrices(rotations.quaternion_of(track[:, 3]))
    if any(spread):
      half[:, :2] *= np.abs(turned[:, 0, :2]).sum(axis=-1, keepdims=True)
      turned = np.eye(3)
    parts.append(
        Shapes(
            np.full(number, geoms[i]),
            origin + track[:, :3] @ axes.T,
            np.broadcast_to(axes @ turned, (number, 3, 3)),
            half + reach,
            reach,
            np.full(number, register.name, object),
            np.fromiter(values[first], object, len(first)),
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
      int(body): name
      for name, register in named.items()
      if register.blocks
      for body in bodies[_geoms(physics, register)]
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
  """Resets a world and puts registers into the middle of their regions.

  No episode has begun, so registers get the constants of their specs.

  Raises:
    SpecError: If a register reads anything but values of its spec.
  """
  mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
  physics.mark_as_dirty()
  for register in named:
    register.settle(physics)
    register.pose(physics, register.initial)
    register.inspect(physics)  # Refuses a wrong kind before any episode.
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
    kind = mujoco.mjtObj.mjOBJ_GEOM
    self._names = np.array(
        [
            mujoco.mj_id2name(model, kind, i) or f'geom {i}'
            for i in range(model.ngeom)
        ],
        object,
    )
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
        np.full(len(geoms), None, object),
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
    geoms = ones.geoms[i], others.geoms[j]
    if geoms[0] == geoms[1]:  # A block of the world in two registers.
      return -np.inf
    for geom, shapes, index in zip(geoms, (ones, others), (i, j), strict=True):
      if shapes.is_box[index]:
        self._model.geom_type[geom] = mujoco.mjtGeom.mjGEOM_BOX
        self._model.geom_size[geom] = shapes.halves[index]
    distance, _ = proximity.distance(
        self._model,
        self._data,
        geoms,
        (ones.centres[i], others.centres[j]),
        (ones.axes[i].ravel(), others.axes[j].ravel()),
        limit + GAP,
    )
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

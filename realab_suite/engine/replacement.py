"""Places of registers in worlds that differ from episode to episode.

Arenas such as mazes are generated anew, and walkers and targets are put
somewhere else. Where a register would then be inside something, it is moved to
the nearest clear place. Nothing is drawn at random, and nothing but registers
moves, so the episodes of the task stay what they are.
"""

from collections.abc import Iterator
import contextlib
import copy
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import solids
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.entities import surroundings
from realab_suite.feedback import mechanisms

# Largest distance along each axis by which a register is moved, in m.
_FARTHEST = 10.0
# Distance that a register that was moved has from everything else, in m.
_CLEARANCE = 0.01
# Largest difference in height between a register and its ground, in m. It
# exceeds the gap under a planar block.
_GAP = 0.01
# Number of places that are checked at once.
_CHUNK = 4096
_PLANE = mujoco.mjtGeom.mjGEOM_PLANE
# Ground of any shape.
_UNEVEN = (
    mujoco.mjtGeom.mjGEOM_HFIELD,
    mujoco.mjtGeom.mjGEOM_MESH,
    mujoco.mjtGeom.mjGEOM_SDF,
)
# MuJoCo computes no distances of these.
_IGNORED_TYPES = (_PLANE, _UNEVEN[0], _UNEVEN[2])
_PARALLEL = 1e-6


@final
class _Blocks(NamedTuple):
  """Blocks of a register, as it stands at the start of an episode.

  Attributes:
    starts: Each block, where the episode begins with it.
    paths: Solids that contain the poses of the blocks for all values.
    start: Bounds of each of `starts`, `(blocks, 2, 3)`, in m.
    reach: Bounds of each of `paths`, `(paths, 2, 3)`, in m.
  """

  starts: list[list[solids.Solid]]
  paths: list[list[solids.Solid]]
  start: np.ndarray
  reach: np.ndarray

  @property
  def footprint(self) -> np.ndarray:
    """Bounds of all blocks for all values, `(2, 3)`, in m."""
    return np.array(
        [self.reach[:, 0].min(axis=0), self.reach[:, 1].max(axis=0)]
    )


def place(
    physics: mjcf.Physics, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Moves registers whose places are not clear to the nearest clear ones.

  A place is clear if the register is on ground, if none of its blocks
  can be inside an immovable object or another register, whatever value is
  written, and if none of them begins inside a movable body. Registers keep
  their angle and height.

  Args:
    physics: Physics of a foreign task that has initialized an episode.
    mechanism: Registers, meters and providers.

  Raises:
    EpisodeInitializationError: If there is no clear place for a register.
  """
  if not mechanism.registers:
    return
  with _unchanged(physics):
    space = solids.Space(physics.model.ptr)
    blocks = {
        name: _find_blocks(physics, register, space)
        for name, register in mechanism.registers.items()
    }
    own = {one.geom for each in blocks.values() for one, *_ in each.starts}
  with _unchanged(physics):
    mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
    world = _World(physics, space, own)
    # A register in a clear place does not make way for another one.
    blocked = []
    for name, each in blocks.items():
      if world.is_clear(each):
        world.occupy(each.reach)
      else:
        blocked.append(name)
    shifts = dict.fromkeys(blocks, np.zeros(2))
    for name in blocked:
      shift = world.nearest_clear_place(blocks[name])
      if shift is None:
        x, y = blocks[name].footprint[:, :2].mean(axis=0)
        raise composer.EpisodeInitializationError(
            f'design {mechanism.design.name!r}: register {name!r} has no clear'
            f' place within {_FARTHEST:g} m of ({x:.3g}, {y:.3g}); place it'
            ' where there is more room, or reduce its range, scale or'
            ' block_size'
        )
      world.occupy(blocks[name].reach + np.array([*shift, 0.0]))
      shifts[name] = shift
  for name, register in mechanism.registers.items():
    _move(physics, register, shifts[name])


def _move(
    physics: mjcf.Physics, register: registers.Register, shift: np.ndarray
) -> None:
  """Moves a register in the plane of the floor, `(2,)`, in m."""
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  rotation = surroundings.matrix(physics.model.body_quat[frame.element_id])
  displacement = ([*shift, 0.0] @ rotation)[:2]
  if shift.any():
    register.settle(physics, displacement)
  for block in register.blocks:
    if isinstance(block, block_kinds.JointedBlock):
      block.surroundings.shift(displacement)


@contextlib.contextmanager
def _unchanged(physics: mjcf.Physics) -> Iterator[None]:
  """Returns a context after which the state is what it was."""
  saved = copy.copy(physics.data.ptr)
  is_dirty = physics.is_dirty
  try:
    yield
  finally:
    mujoco.mj_copyData(physics.data.ptr, physics.model.ptr, saved)
    if is_dirty:
      physics.mark_as_dirty()


def _find_blocks(
    physics: mjcf.Physics, register: registers.Register, space: solids.Space
) -> _Blocks:
  """Returns where the blocks of a register are, and can be written to.

  Args:
    physics: Physics; its state is changed.
    register: The register.
    space: Space of the model.
  """
  still = np.zeros(2)
  regions = solids.initial_regions(physics, register, still)
  starts = [region.hulls for region in regions]
  paths = [one.hulls for one in solids.regions(physics, register, still)]
  return _Blocks(
      starts,
      paths,
      np.array([space.bounds(hull) for hull, *_ in starts]),
      np.array([space.bounds(hull) for hull, *_ in paths]),
  )


@final
class _World:
  """Everything solid in a world, except the registers that are to be placed."""

  def __init__(
      self, physics: mjcf.Physics, space: solids.Space, own: set[int]
  ) -> None:
    """Collects the geoms of a physics in its present state.

    Args:
      physics: Physics of one world.
      space: Space of its model.
      own: Geoms of registers.
    """
    model, data = physics.model, physics.data.ptr
    self._space = space
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    solid[list(own)] = False
    carriers = model.body_weldid[model.geom_bodyid]
    fixed = (carriers == 0) | (model.body_mocapid[carriers] >= 0)
    matrices = np.reshape(data.geom_xmat, (-1, 3, 3)).copy()
    is_plane = model.geom_type == _PLANE
    planes = np.flatnonzero(solid & is_plane)
    self._normals = matrices[planes, :, 2]
    self._offsets = (self._normals * data.geom_xpos[planes]).sum(axis=1)
    measured = solid & ~np.isin(model.geom_type, _IGNORED_TYPES)
    self._fixed, self._movable = (
        [
            space.solid(geom, np.array(data.geom_xpos[geom]), matrices[geom])
            for geom in np.flatnonzero(mask).tolist()
        ]
        for mask in (measured & fixed, measured & ~fixed)
    )
    self._fixed_bounds = self._bounds_of(self._fixed)
    self._movable_bounds = self._bounds_of(self._movable)
    # Ground: planes that face up, and tops of upright boxes.
    self._has_uneven = bool(
        (solid & fixed & np.isin(model.geom_type, _UNEVEN)).any()
    )
    is_upright = np.abs(matrices[:, 2, 2] - 1.0) < _PARALLEL
    is_aligned = np.isclose(np.abs(matrices[:, :2, :2]).max(axis=1), 1.0).all(1)
    is_box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    ground = solid & fixed & is_upright & (is_plane | (is_box & is_aligned))
    self._grounds = []
    for geom in np.flatnonzero(ground).tolist():
      half = np.array(model.geom_size[geom])
      half[:2] = np.abs(matrices[geom, :2, :2]) @ half[:2]
      if is_plane[geom]:
        half[2] = 0.0
        # Without a size, planes are drawn without an end.
        half[:2][model.geom_size[geom][:2] == 0.0] = np.inf
      centre = data.geom_xpos[geom]
      self._grounds.append((bool(is_plane[geom]), centre - half, centre + half))

  def occupy(self, reach: np.ndarray) -> None:
    """Adds the bounds of a register, `(blocks, 2, 3)`, as obstacles."""
    self._fixed_bounds = np.concatenate([self._fixed_bounds, reach])

  def is_clear(self, blocks: _Blocks) -> bool:
    """Returns True if a register can stay where it is."""
    footprint = blocks.footprint
    if not self._is_on_ground(footprint):
      return False
    if self._is_behind_plane(blocks.reach, np.zeros((1, 2))).any():
      return False
    # Registers come after the geoms of the world.
    taken = self._fixed_bounds[len(self._fixed) :]
    if any(_overlap(one, taken).any() for one in blocks.reach):
      return False
    return not (
        self._meets(blocks.paths, self._fixed, self._fixed_bounds)
        or self._meets(blocks.starts, self._movable, self._movable_bounds)
    )

  def nearest_clear_place(self, blocks: _Blocks) -> np.ndarray | None:
    """Returns the shift to the nearest clear place, `(2,)`, in m, or `None`."""
    step = float(np.diff(blocks.start[0], axis=0).min()) / 2
    shifts = self._shifts_on_ground(blocks.footprint, step)
    margin = np.array([[-_CLEARANCE] * 3, [_CLEARANCE] * 3])
    # A register stands on its ground.
    margin[0, 2] = solids.TOLERANCE
    for i in range(0, len(shifts), _CHUNK):
      some = shifts[i : i + _CHUNK]
      blocked = self._is_behind_plane(blocks.reach, some)
      for bounds, obstacles in (
          (blocks.reach, self._fixed_bounds),
          (blocks.start, self._movable_bounds),
      ):
        for one in bounds + margin:
          for obstacle in obstacles:
            low, high = obstacle[0] - one[1], obstacle[1] - one[0]
            if low[2] < 0.0 < high[2]:
              inside = (low[:2] < some) & (some < high[:2])
              blocked |= inside.all(axis=1)
      if not blocked.all():
        return some[int(np.argmin(blocked))]
    return None

  def _bounds_of(self, geoms: list[solids.Solid]) -> np.ndarray:
    """Returns the bounds of geoms, `(geoms, 2, 3)`, in m."""
    return np.reshape([self._space.bounds(geom) for geom in geoms], (-1, 2, 3))

  def _meets(
      self,
      blocks: list[list[solids.Solid]],
      obstacles: list[solids.Solid],
      bounds: np.ndarray,
  ) -> bool:
    """Returns True if a block can be inside an obstacle."""
    return any(
        self._space.meet(hulls, [obstacles[i]]) is not None
        for hulls in blocks
        for i in np.flatnonzero(
            _overlap(self._space.bounds(hulls[0]), bounds)[: len(obstacles)]
        ).tolist()
    )

  def _is_behind_plane(
      self, reach: np.ndarray, shifts: np.ndarray
  ) -> np.ndarray:
    """Returns True where a block can be behind a plane, `(shifts,)` bool."""
    centres, halves = reach.mean(axis=1), np.diff(reach, axis=1)[:, 0] / 2
    ahead = centres @ self._normals.T - halves @ np.abs(self._normals).T
    moved = shifts @ self._normals[:, :2].T
    nearest = ahead.min(axis=0) - self._offsets + moved
    return (nearest < -solids.TOLERANCE).any(axis=1)

  def _is_on_ground(self, footprint: np.ndarray) -> bool:
    """Returns True if a register is on ground, or if there is none.

    Planes are endless. Surfaces above the floor are checked when a task is
    embedded.

    Args:
      footprint: Bounds of the register, `(2, 3)`, in m.
    """
    if footprint[0, 2] > _GAP or self._has_uneven:
      return True
    grounds = self._grounds_of(footprint)
    return not grounds or any(
        is_plane or _is_within(footprint, low, high)
        for is_plane, low, high in grounds
    )

  def _grounds_of(
      self, footprint: np.ndarray
  ) -> list[tuple[bool, np.ndarray, np.ndarray]]:
    """Returns the grounds with their top at the underside of a register.

    Each is `(is_plane, low, high)`; see `_is_on_ground`.
    """
    return [
        ground
        for ground in self._grounds
        if abs(ground[2][2] - footprint[0, 2]) <= _GAP
    ]

  def _shifts_on_ground(self, footprint: np.ndarray, step: float) -> np.ndarray:
    """Returns the shifts to places on ground that is drawn, nearest first.

    Args:
      footprint: Bounds of the register, `(2, 3)`, in m.
      step: Distance between neighbouring places, in m.

    Returns:
      `(shifts, 2)`, in m.
    """
    found = [np.zeros((0, 2))]
    for _, low, high in self._grounds_of(footprint):
      first = np.maximum(low[:2] - footprint[0, :2], -_FARTHEST)
      last = np.minimum(high[:2] - footprint[1, :2], _FARTHEST)
      x, y = (
          step * np.arange(np.ceil(first[i] / step), last[i] / step + 1e-9)
          for i in range(2)
      )
      found.append(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    shifts = np.concatenate(found)
    distance = np.hypot(*shifts.T).round(6)
    return shifts[np.lexsort((*shifts.T, distance))]


def _overlap(bounds: np.ndarray, others: np.ndarray) -> np.ndarray:
  """Returns True where bounds, `(n, 2, 3)`, overlap some others, `(n,)`."""
  return ((others[:, 0] < bounds[1]) & (bounds[0] < others[:, 1])).all(axis=1)


def _is_within(footprint: np.ndarray, low: Any, high: Any) -> bool:
  """Returns True if bounds, `(2, 3)`, are within others in the plane."""
  return bool(
      (low[:2] <= footprint[0, :2]).all()
      and (footprint[1, :2] <= high[:2]).all()
  )

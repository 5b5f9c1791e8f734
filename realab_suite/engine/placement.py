"""Checks of register positions, for all values and all points of a region."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import supports
from realab_suite.engine import swept_volumes
from realab_suite.entities import arenas
from realab_suite.entities import moving
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base

_SOLVERS = (mujoco.mjtSolver.mjSOL_CG, mujoco.mjtSolver.mjSOL_NEWTON)
# Geom types that are not checked. Planes are the ground, or are placed when an
# episode begins, as in corridors of dm_control. MuJoCo computes no distances of
# the others.
_IGNORED_TYPES = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_HFIELD,
    mujoco.mjtGeom.mjGEOM_SDF,
)
# Fractions of a range at which registers are written to measure the motion of
# their blocks. Uneven spacing distinguishes a periodic motion from rest.
_COARSE = np.array([0.0, 0.07, 0.19, 0.3, 0.42, 0.55, 0.69, 0.81, 0.92, 1.0])
# The same for registers whose blocks do not move along straight lines.
_FINE = np.linspace(0.0, 1.0, 257)
# Largest numerical deviation from a straight line, relative to its length.
_NOISE = 1e-9

_Registers = Mapping[str, registers.Register]
_Paths = dict[str, list[swept_volumes.Sweep]]


def check(
    physics: mjcf.Physics,
    root: composer.Entity,
    mechanism: mechanisms.FeedbackMechanism,
) -> None:
  """Checks that no write can move a block to an invalid position.

  The check covers every value of a register and every point of its region.
  Overlaps of up to `swept_volumes.TOLERANCE` are accepted. The state is reset
  at the end.

  Args:
    physics: Physics of one world.
    root: Root entity.
    mechanism: Registers, meters and providers.

  Raises:
    SpecError: If a block could leave the arena, overlap an immovable object or
      another register, or be above the floor with nothing under it; or if the
      solver lets meters affect bodies that they do not touch.
  """
  _check_solver(physics, mechanism)
  space = swept_volumes.Space(physics.model.ptr)
  paths = _reachable_poses(physics, mechanism.registers)
  obstacles = _SweepIndex(space)
  obstacles.add('', _obstacles(physics, root, paths))
  surfaces = supports.Surfaces(physics)
  blocks = _SweepIndex(space)
  for name, path in paths.items():
    for sweep in path:
      _check_extent(name, sweep, root, space)
      if (pose := surfaces.find_unsupported(sweep)) is not None:
        raise errors.SpecError(
            f'{_describe(name, pose)} and a height of {pose.centre[2]:.3g} m,'
            ' with nothing under its centre that stays in place; place it on'
            ' one table or shelf for all of its range, or on the floor'
        )
      for _, obstacle in obstacles.near(sweep):
        if (found := space.meet(sweep, obstacle)) is not None:
          pose, distance = found
          geom = physics.model.id2name(obstacle.geom, 'geom')
          raise errors.SpecError(
              f'{_describe(name, pose)}, {-distance:.2g} m inside'
              f' {geom or f"geom {obstacle.geom}"!r}; place it elsewhere or'
              ' narrow its range'
          )
      for other, taken in blocks.near(sweep):
        if space.meet(sweep, taken) is not None:
          raise errors.SpecError(
              f"registers {other!r} and {name!r} would be in each other's way:"
              f' {_filled(space, paths[other])} and {_filled(space, path)};'
              ' place them apart or narrow their ranges'
          )
    blocks.add(name, path)
  physics.reset()


def check_start(
    physics: mjcf.Physics,
    task: base.Task,
    mechanism: mechanisms.FeedbackMechanism,
) -> None:
  """Checks that no episode begins with the avatar inside a block.

  The state is reset at the end.

  Args:
    physics: Physics of one world.
    task: Task of this package.
    mechanism: Registers, meters and providers.

  Raises:
    SpecError: If a block could overlap the avatar when an episode begins.
  """
  low, high = np.array(task.start.low), np.array(task.start.high)
  space = swept_volumes.Space(physics.model.ptr)
  # A geom of the avatar represents all initial positions of its centre.
  body = physics.bind(task.avatar.body).element_id
  geom = int(physics.model.body_geomadr[body])
  space.make_box(geom, np.array([*(high - low) / 2, 1.0]))
  start = swept_volumes.Sweep(
      geom, np.array([*(low + high) / 2, 0.0]), np.eye(3)
  )
  for name, path in _initial_poses(physics, mechanism.registers).items():
    for sweep in path:
      if space.meet(sweep, start, clearance=task.avatar.radius) is not None:
        raise errors.SpecError(
            f'register {name!r} would be at {_filled(space, [sweep])}, where'
            f' the avatar begins, {_format(low, high)}; place it elsewhere'
        )
  physics.reset()


@final
class _SweepIndex:
  """A collection of sweeps with a fast search for those near another one."""

  def __init__(self, space: swept_volumes.Space) -> None:
    self._space = space
    self._members: list[tuple[str, swept_volumes.Sweep]] = []
    self._bounds = np.zeros((0, 2, 3))

  def add(self, name: str, path: Sequence[swept_volumes.Sweep]) -> None:
    """Adds sweeps with the same name."""
    if path:
      bounds = [self._space.bounds(sweep) for sweep in path]
      self._bounds = np.concatenate([self._bounds, bounds])
      self._members += [(name, sweep) for sweep in path]

  def near(
      self, sweep: swept_volumes.Sweep
  ) -> Iterator[tuple[str, swept_volumes.Sweep]]:
    """Yields the sweeps, with their names, whose bounds overlap those given."""
    low, high = self._space.bounds(sweep)
    is_near = (self._bounds[:, 0] <= high) & (low <= self._bounds[:, 1])
    for i in np.flatnonzero(is_near.all(axis=1)):
      yield self._members[i]


def _initial_poses(physics: mjcf.Physics, named: _Registers) -> _Paths:
  """Returns the poses of blocks when an episode begins, by register.

  Afterwards, every register is in the middle of its region.
  """
  poses = []
  for corner in ((1.0, 0.0), (0.0, 1.0), (0.0, 0.0)):
    mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
    physics.mark_as_dirty()
    for register in named.values():
      register.settle(physics, register.spread * corner)
    mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
    poses.append(np.array(physics.data.geom_xpos))
  matrices = np.array(physics.data.geom_xmat).reshape(-1, 3, 3)
  along, aside, centres = poses
  motions = np.zeros((len(centres), 2, 5))
  motions[:, 0, :3] = along - centres
  motions[:, 1, :3] = aside - centres
  return {
      name: [
          swept_volumes.Sweep(i, centres[i], matrices[i], motions[i])
          for i in (physics.bind(b.geom).element_id for b in register.blocks)
      ]
      for name, register in named.items()
  }


def _reachable_poses(physics: mjcf.Physics, named: _Registers) -> _Paths:
  """Returns the poses of blocks after a write of any value, by register."""
  initial = _initial_poses(physics, named)
  coarse = _trace(physics, named, _COARSE)
  curved = {
      name: register
      for name, register in named.items()
      if not _is_straight(coarse[:, [sweep.geom for sweep in initial[name]]])
  }
  fine = _trace(physics, curved, _FINE) if curved else coarse
  paths: _Paths = {}
  for name, register in named.items():
    # One segment for a straight line, otherwise one between adjacent samples.
    trace = fine if name in curved else coarse[[0, -1]]
    spec = register.value_spec
    values = np.linspace(spec.minimum, spec.maximum, len(trace))
    paths[name] = [
        segment
        for sweep in initial[name]
        for segment in _segments(
            sweep,
            np.column_stack([trace[:, sweep.geom], values]),
            physics.model.geom_rbound[sweep.geom],
        )
    ]
  return paths


def _trace(
    physics: mjcf.Physics, named: _Registers, fractions: np.ndarray
) -> np.ndarray:
  """Poses all registers for values and returns the resulting poses of geoms.

  Args:
    physics: Physics of one world.
    named: Registers, by name.
    fractions: Values to write, as fractions of each register's range.

  Returns:
    Centre of each geom, in metres, and its angle about the vertical, in
    radians, `(fractions, geoms, 4)`.
  """
  trace = []
  for fraction in fractions:
    for register in named.values():
      spec = register.value_spec
      value = spec.minimum + fraction * (spec.maximum - spec.minimum)
      register.pose(physics, np.clip(value, spec.minimum, spec.maximum))
    mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
    matrices = physics.data.geom_xmat
    angles = np.arctan2(matrices[:, 3], matrices[:, 0])
    trace.append(np.column_stack([physics.data.geom_xpos, angles]))
  traced = np.array(trace)
  traced[..., 3] = np.unwrap(traced[..., 3], axis=0)
  return traced


def _is_straight(trace: np.ndarray) -> bool:
  """Returns True if geoms move in straight lines, in proportion to `_COARSE`.

  Args:
    trace: Poses of geoms for each of `_COARSE`, `(fractions, geoms, 4)`.
  """
  line = trace[-1] - trace[0]
  even = trace[0] + np.multiply.outer(_COARSE, line)
  return bool(np.abs(trace - even).max() <= _NOISE * (1 + np.abs(line).max()))


def _segments(
    sweep: swept_volumes.Sweep, trace: np.ndarray, radius: float
) -> list[swept_volumes.Sweep]:
  """Returns the poses of a geom as sweeps between adjacent samples.

  Args:
    sweep: Poses of the geom when an episode begins.
    trace: Centre, angle and value of each sample, `(samples, 5)`.
    radius: Radius of the geom, in metres.
  """
  # Between two samples, a curve deviates from the straight line by at most an
  # eighth of its second difference, and a corner by at most half of it.
  curvature = np.zeros(len(trace))
  bends = np.abs(np.diff(trace, 2, axis=0))
  curvature[1:-1] = np.linalg.norm(bends[:, :3], axis=1) + radius * bends[:, 3]
  angle = np.arctan2(sweep.matrix[1, 0], sweep.matrix[0, 0])
  segments = []
  for i in range(len(trace) - 1):
    middle = (trace[i] + trace[i + 1]) / 2
    segments.append(
        swept_volumes.Sweep(
            sweep.geom,
            middle[:3],
            swept_volumes.turned(sweep.matrix, middle[3] - angle),
            np.vstack([sweep.motions, (trace[i + 1] - trace[i]) / 2]),
            float(middle[4]),
            float(curvature[i : i + 2].max()),
        )
    )
  return segments


def _obstacles(
    physics: mjcf.Physics, root: composer.Entity, paths: _Paths
) -> list[swept_volumes.Sweep]:
  """Returns the poses of solid, immovable geoms."""
  mujoco.mj_resetData(physics.model.ptr, physics.data.ptr)
  physics.mark_as_dirty()
  mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
  model, data = physics.model, physics.data
  matrices = np.array(data.geom_xmat).reshape(-1, 3, 3)
  is_solid = (model.geom_contype | model.geom_conaffinity) != 0
  # Mocap bodies such as doors move, but cannot be pushed.
  carriers = model.body_weldid[model.geom_bodyid]
  is_fixed = (carriers == 0) | (model.body_mocapid[carriers] >= 0)
  is_ignored = np.isin(model.geom_type, _IGNORED_TYPES)
  own_geoms = {sweep.geom for path in paths.values() for sweep in path}
  travels = _travels(physics, root)
  obstacles = []
  for geom in np.flatnonzero(is_solid & is_fixed & ~is_ignored).tolist():
    if geom in own_geoms:
      continue
    half = np.zeros(5)
    half[:3] = np.array(travels.get(geom, (0.0, 0.0, 0.0))) / 2
    obstacles.append(
        swept_volumes.Sweep(
            geom, data.geom_xpos[geom] + half[:3], matrices[geom], half[None]
        )
    )
  return obstacles


def _travels(
    physics: mjcf.Physics, root: composer.Entity
) -> dict[int, np.ndarray]:
  """Returns the displacement of moving parts in an episode, by geom, `(3,)`."""
  return {
      physics.bind(geom).element_id: entity.travel
      for entity in root.iter_entities()
      if isinstance(entity, moving.MovingPart)
      for geom in entity.geoms
  }


def _check_extent(
    name: str,
    sweep: swept_volumes.Sweep,
    root: composer.Entity,
    space: swept_volumes.Space,
) -> None:
  """Refuses a block whose centre can leave the arena, or that is too high."""
  if not isinstance(root, arenas.RoomArena):
    return
  if (top := space.bounds(sweep)[1][2]) > root.ceiling:
    raise errors.SpecError(
        f'register {name!r} would reach a height of {top:.3g} m; allowed in'
        f' this arena are at most {root.ceiling:g} m'
    )
  for axis in range(2):
    for side in (-1.0, 1.0):
      ahead = side * sweep.motions[:, axis]
      pose = sweep.pose(np.where(ahead > 0, 1.0, -1.0))
      if not root.extent.contains(pose.centre[:2].tolist()):
        raise errors.SpecError(
            f'{_describe(name, pose)}, outside the arena'
            f' {_format(root.extent.low, root.extent.high)}'
        )


def _describe(name: str, pose: swept_volumes.Sweep) -> str:
  return (
      f'register {name!r} at value {pose.value:g} would be at'
      f' {_format(pose.centre[:2])}'
  )


def _filled(
    space: swept_volumes.Space, path: Sequence[swept_volumes.Sweep]
) -> str:
  """Returns the rectangle that sweeps fill, as text."""
  bounds = np.array([space.bounds(sweep) for sweep in path])
  return _format(bounds[:, 0, :2].min(axis=0), bounds[:, 1, :2].max(axis=0))


def _check_solver(
    physics: mjcf.Physics, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Refuses a solver that lets meters affect bodies that they do not touch.

  With solvers other than Newton and CG, or without islands, the block of a
  meter register changes the motion of distant bodies.
  """
  if not mechanism.design.meters:
    return
  option = physics.model.opt
  if option.solver not in _SOLVERS:
    name = mujoco.mjtSolver(option.solver).name
    raise errors.SpecError(
        f'option.solver: {name}; meters need Newton or CG, with islands'
    )
  if option.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND:
    raise errors.SpecError(
        'option.flag.island: disabled; meters need Newton or CG, with islands'
    )
  if option.noslip_iterations and option.noslip_tolerance > 0:
    raise errors.SpecError(
        f'option.noslip_tolerance: {option.noslip_tolerance:g} couples bodies,'
        ' because it ends the noslip pass for all; meters need 0, or no noslip'
        ' pass'
    )


def _format(*points: Any) -> str:
  """Returns points as text, as in '(1.2, -3.6) to (2.4, -3.0)'."""
  return ' to '.join(
      f'({", ".join(f"{x:.3g}" for x in point)})' for point in points
  )

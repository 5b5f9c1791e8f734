"""Checks of register positions, for all values and all points of a region."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import solids
from realab_suite.engine import starts
from realab_suite.engine import supports
from realab_suite.entities import arenas
from realab_suite.entities import moving
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

_Regions = Mapping[str, list[solids.Region]]


def check(
    physics: mjcf.Physics,
    root: composer.Entity,
    mechanism: mechanisms.FeedbackMechanism,
) -> None:
  """Checks that no write can move a block to an invalid position.

  The check covers every value of a register and every point of its region.
  Overlaps of up to `solids.TOLERANCE` are accepted. The state is reset at the
  end.

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
  space = solids.Space(physics.model.ptr)
  solids.settle(physics, mechanism.registers.values())
  reachable = {
      name: solids.regions(physics, register, register.spread)
      for name, register in mechanism.registers.items()
  }
  solids.settle(physics, mechanism.registers.values())
  obstacles = _Index(space)
  for obstacle in _obstacles(physics, root, space, reachable):
    obstacles.add(obstacle)
  surfaces = supports.Surfaces(physics)
  blocks = _Index(space)
  for name, path in reachable.items():
    for region in path:
      _check_extent(name, region, root, space)
      if (point := surfaces.find_unsupported(region)) is not None:
        value, _ = region.poses_near(point)[0]
        raise errors.SpecError(
            f'{_describe(name, value, point)} and a height of {point[2]:.3g} m,'
            ' with nothing under its centre that stays in place; place it on'
            ' one table or shelf for all of its range, or on the floor'
        )
      for found in obstacles.near(region.hulls):
        if (point := space.meet(region.hulls, found.hulls, found.way)) is None:
          continue
        raise errors.SpecError(
            f'{space.describe(name, region, point, found.hulls[0])}; place it'
            ' elsewhere or narrow its range'
        )
      for found in blocks.near(region.hulls):
        if space.meet(region.hulls, found.hulls) is not None:
          other = found.name
          raise errors.SpecError(
              f"registers {other!r} and {name!r} would be in each other's way:"
              f' {_filled(space, reachable[other])} and {_filled(space, path)};'
              ' place them apart or narrow their ranges'
          )
    for region in path:
      blocks.add(_Obstacle(name, region.hulls))
  physics.reset()


def check_start(
    physics: mjcf.Physics,
    task: base.Task,
    mechanism: mechanisms.FeedbackMechanism,
) -> None:
  """Checks that no episode begins with something movable inside a block.

  This covers every position of the avatar, and other bodies where the compiled
  model has them; `starts` checks where episodes put them. The state is reset at
  the end.

  Args:
    physics: Physics of one world.
    task: Task of this package.
    mechanism: Registers, meters and providers.

  Raises:
    SpecError: If a block could overlap the avatar or another body when an
      episode begins.
  """
  low, high = np.array(task.start.low), np.array(task.start.high)
  space = solids.Space(physics.model.ptr)
  # A geom of the avatar represents all initial positions of its centre.
  body = physics.bind(task.avatar.body).element_id
  start = solids.Solid(
      int(physics.model.body_geomadr[body]),
      np.array([*(low + high) / 2, 0.0]),
      np.eye(3),
      np.array([*(high - low) / 2, 1.0]),
  )
  radius = task.avatar.radius
  solids.settle(physics, mechanism.registers.values())
  bodies = starts.movable_geoms(physics, task, mechanism)
  for name, register in mechanism.registers.items():
    for region in solids.initial_regions(physics, register, register.spread):
      problem = ''
      if space.meet(region.hulls, [start], clearance=radius) is not None:
        problem = f'where the avatar begins, {_format(low, high)}'
      for geom in bodies:
        if space.meet(region.hulls, [space.posed(physics, geom)]) is not None:
          problem = f'inside {geom.full_identifier!r} when an episode begins'
      if problem:
        raise errors.SpecError(
            f'register {name!r} would be at {_filled(space, [region])},'
            f' {problem}; place it elsewhere'
        )
  physics.reset()


@final
class _Obstacle(NamedTuple):
  """Something that registers keep apart from.

  Attributes:
    name: Name of the register that it belongs to, or ''.
    hulls: Solids, each of which contains it.
    way: Displacement to the far end of its way, `(3,)`, in m, or `None`.
  """

  name: str
  hulls: list[solids.Solid]
  way: np.ndarray | None = None


@final
class _Index:
  """A collection of obstacles with a fast search for those near others."""

  def __init__(self, space: solids.Space) -> None:
    self._space = space
    self._members: list[_Obstacle] = []
    self._bounds = np.zeros((0, 2, 3))

  def add(self, obstacle: _Obstacle) -> None:
    """Adds an obstacle."""
    bounds = self._space.bounds(obstacle.hulls[0], obstacle.way)
    self._bounds = np.concatenate([self._bounds, bounds[np.newaxis]])
    self._members.append(obstacle)

  def near(self, hulls: Sequence[solids.Solid]) -> Iterator[_Obstacle]:
    """Yields the obstacles whose bounds overlap those of a block."""
    low, high = self._space.bounds(hulls[0])
    is_near = (self._bounds[:, 0] <= high) & (low <= self._bounds[:, 1])
    for i in np.flatnonzero(is_near.all(axis=1)):
      yield self._members[i]


def _obstacles(
    physics: mjcf.Physics,
    root: composer.Entity,
    space: solids.Space,
    regions: _Regions,
) -> Iterator[_Obstacle]:
  """Yields the solid geoms that nothing can push, with their ways."""
  model, data = physics.model, physics.data
  is_solid = (model.geom_contype | model.geom_conaffinity) != 0
  # Mocap bodies such as doors move, but cannot be pushed.
  carriers = model.body_weldid[model.geom_bodyid]
  is_fixed = (carriers == 0) | (model.body_mocapid[carriers] >= 0)
  is_ignored = np.isin(model.geom_type, _IGNORED_TYPES)
  own_geoms = {region.geom for path in regions.values() for region in path}
  ways = {
      physics.bind(geom).element_id: part.travel
      for part in root.iter_entities()
      if isinstance(part, moving.MovingPart)
      for geom in part.mjcf_model.find_all('geom')
  }
  for geom in np.flatnonzero(is_solid & is_fixed & ~is_ignored).tolist():
    if geom not in own_geoms:
      matrix = np.reshape(data.geom_xmat[geom], (3, 3)).copy()
      solid = space.solid(geom, np.array(data.geom_xpos[geom]), matrix)
      yield _Obstacle('', [solid], ways.get(geom))


def _check_extent(
    name: str,
    region: solids.Region,
    root: composer.Entity,
    space: solids.Space,
) -> None:
  """Refuses a block whose centre can leave the arena, or that is too high."""
  if not isinstance(root, arenas.RoomArena):
    return
  if (top := space.bounds(region.hulls[0])[1][2]) > root.ceiling:
    raise errors.SpecError(
        f'register {name!r} would reach a height of {top:.3g} m; allowed in'
        f' this arena are at most {root.ceiling:g} m'
    )
  for point in region.corners():
    if not root.extent.contains(point[:2].tolist()):
      value, _ = region.poses_near(point)[0]
      raise errors.SpecError(
          f'{_describe(name, value, point)}, outside the arena'
          f' {_format(root.extent.low, root.extent.high)}'
      )


def _describe(name: str, value: float, point: np.ndarray) -> str:
  return (
      f'register {name!r} at value {value:g} would be at {_format(point[:2])}'
  )


def _filled(space: solids.Space, regions: Sequence[solids.Region]) -> str:
  """Returns the rectangle that blocks fill, as text."""
  bounds = np.array([space.bounds(region.hulls[0]) for region in regions])
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
  """Returns points as text, as in '(1.2, -3.6) to (2.4, -3)'."""
  return ' to '.join(
      f'({", ".join(f"{x:.3g}" for x in point)})' for point in points
  )

"""Where registers may be: checks of a loaded world, and of each episode.

A register is posed at many values, in its whole region, and MuJoCo measures
what its blocks are inside of; see `clearance`.
"""

from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import clearance
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import moving
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base

_SOLVERS = (mujoco.mjtSolver.mjSOL_CG, mujoco.mjtSolver.mjSOL_NEWTON)
# Distance between the poses of a part on its way, in m: no block is smaller
# than twice this distance.
_STEP = block_kinds.LEAST_SIZE / 2
# Smallest half width of a box, in m.
_THIN = 1e-6


def survey(
    physics: mjcf.Physics,
    mechanism: mechanisms.FeedbackMechanism,
    is_spread: bool = False,
) -> clearance.Survey:
  """Returns the survey of a newly compiled world, which is reset.

  Args:
    physics: Physics of one world.
    mechanism: Registers, meters and providers.
    is_spread: As in `clearance.survey`.
  """
  clearance.settle(physics, mechanism.registers.values())
  try:
    return clearance.survey(physics, mechanism.registers, is_spread)
  finally:
    physics.reset()


def check(
    physics: mjcf.Physics,
    root: composer.Entity,
    mechanism: mechanisms.FeedbackMechanism,
    surveyed: clearance.Survey | None = None,
) -> None:
  """Checks the places of registers in a newly compiled world.

  Overlaps of up to `clearance.TOLERANCE` are accepted.

  Args:
    physics: Physics of one world.
    root: Root entity.
    mechanism: Registers, meters and providers.
    surveyed: The survey of the world, in the whole regions of registers; `None`
      to make it, which resets the state.

  Raises:
    SpecError: If a block could leave the arena, be inside an immovable object
      or another register, or be above the floor with nothing under it; or if
      the solver lets meters affect bodies that they do not touch.
  """
  _check_solver(physics, mechanism)
  if surveyed is None:
    surveyed = survey(physics, mechanism, is_spread=True)
  space = surveyed.space
  # Planes are the ground, or are placed when an episode begins, as in corridors
  # of dm_control.
  mask = surveyed.others(space.is_fixed & ~space.is_plane)
  obstacles = _along_ways(physics, root, surveyed.select(mask))
  placed: list[clearance.Shapes] = []
  for name, blocks in surveyed.paths.items():
    _check_extent(name, blocks, root)
    _check_support(name, blocks, space)
    for i, j in space.meetings(blocks, obstacles):
      raise errors.SpecError(
          f'register {name!r} {blocks.describe(i)}, inside'
          f' {obstacles.names[j]!r}; place it elsewhere or narrow'
          ' its range'
      )
    neighbours = clearance.joined(placed) if placed else blocks.only([])
    for i, j in space.meetings(blocks, neighbours):
      raise errors.SpecError(
          f'registers {neighbours.names[j]!r} and {name!r} would be in each'
          f" other's way: the first {neighbours.describe(j)}, the second"
          f' {blocks.describe(i)}; place them apart or narrow their ranges'
      )
    placed.append(blocks)


@final
class Placement:
  """Checks of the registers in a task of this package.

  A task may move walls and other parts at the start of an episode, and put
  bodies somewhere. The check of an episode costs next to nothing in worlds
  where all parts are where the compiled model has them.
  """

  def __init__(
      self,
      physics: mjcf.Physics,
      task: base.Task,
      mechanism: mechanisms.FeedbackMechanism,
  ) -> None:
    """Finds the parts that the task can move.

    Args:
      physics: Physics of one world, whose state is reset.
      task: Task of this package, with `mechanism` attached.
      mechanism: Registers, meters and providers.
    """
    self._task, self._mechanism = task, mechanism
    self._survey = surveyed = survey(physics, mechanism)
    self._movable = _movable(physics, task, surveyed)
    carriers = physics.model.body_weldid[physics.model.geom_bodyid]
    self._is_part = surveyed.others(physics.model.body_mocapid[carriers] >= 0)
    self._homes = surveyed.select(self._is_part)
    model, data = physics.model, physics.data
    self._mocap = np.unique(model.body_mocapid[carriers[self._homes.geoms]])
    self._home_poses = _mocap_poses(data, self._mocap)
    bodies = surveyed.select(self._movable)
    self._is_needed = bool(surveyed.starts) and bool(
        len(self._homes.geoms) + len(bodies.geoms)
    )

  def check(self, physics: mjcf.Physics) -> None:
    """Checks the whole regions of registers, before the first episode.

    Besides what `check` refuses, nothing movable may begin inside a block: the
    avatar in any of its positions, and other bodies where the compiled model
    has them.

    Args:
      physics: Physics of the world, whose state may be reset.

    Raises:
      SpecError: If something is in the way of a register.
    """
    mechanism, surveyed = self._mechanism, self._survey
    if any(one.spread.any() for one in mechanism.registers.values()):
      surveyed = survey(physics, mechanism, is_spread=True)
    check(physics, self._task.root_entity, mechanism, surveyed)
    space, bodies = surveyed.space, surveyed.select(self._movable)
    start = _start_of_avatar(physics, self._task, surveyed)
    least = self._task.avatar.radius - clearance.TOLERANCE
    for name, blocks in surveyed.starts.items():
      problems = [
          (i, 'where the avatar begins')
          for i in range(len(blocks.geoms))
          if space.distance(blocks, i, start, 0, least) < least
      ] + [
          (i, f'inside {bodies.names[j]!r} when an episode begins')
          for i, j in space.meetings(blocks, bodies)
      ]
      for i, problem in problems:
        raise errors.SpecError(
            f'register {name!r} {blocks.describe(i)}, {problem}; place it'
            ' elsewhere'
        )

  def check_start(self, physics: Any) -> None:
    """Checks an episode that has just been initialized.

    Args:
      physics: Physics of this world, or of a world of a batch.

    Raises:
      EpisodeInitializationError: If something is inside a register. The next
        attempt may draw other positions.
    """
    if not self._is_needed:
      return
    space = self._survey.space
    data = space.at(physics.state)
    poses = _mocap_poses(data, self._mocap)
    if not self._movable.any() and np.array_equal(poses, self._home_poses):
      return
    space.update()
    bodies = space.shapes(data, self._movable)
    parts = space.shapes(data, self._is_part)
    is_moved = (parts.centres != self._homes.centres).any(axis=1)
    is_moved |= (parts.axes != self._homes.axes).any(axis=(1, 2))
    if not len(bodies.geoms) + is_moved.sum():
      return
    parts = _along_ways(physics, self._task.root_entity, parts.only(is_moved))
    for name, blocks in self._survey.starts.items():
      register = self._mechanism.registers[name]
      shift = data.geom_xpos[blocks.geoms[0]] - blocks.centres[0]
      self._refuse(register, self._survey.paths[name].moved(shift), parts)
      if len(bodies.geoms):
        self._refuse(register, clearance.start(physics, register), bodies)

  def _refuse(
      self, register: Any, blocks: clearance.Shapes, obstacles: clearance.Shapes
  ) -> None:
    """Raises an error if a block of a register is inside something."""
    for i, j in self._survey.space.meetings(blocks, obstacles):
      raise composer.EpisodeInitializationError(
          f'design {self._mechanism.design.name!r}: register {register.name!r}'
          f' {blocks.describe(i)}, inside {obstacles.names[j]!r} when the'
          ' episode begins; place the register elsewhere, narrow its range, or'
          ' keep the other away'
      )


def _movable(
    physics: mjcf.Physics, task: base.Task, surveyed: clearance.Survey
) -> np.ndarray:
  """Returns True for geoms of bodies that can be pushed, `(geoms,)` bool.

  Those of the avatar and of registers are not among them.
  """
  model = physics.model
  roots = model.body_rootid[model.geom_bodyid]
  avatar = int(physics.bind(task.avatar.body).element_id)
  return surveyed.others(
      ~surveyed.space.is_fixed & (roots != model.body_rootid[avatar])
  )


def _start_of_avatar(
    physics: mjcf.Physics, task: base.Task, surveyed: clearance.Survey
) -> clearance.Shapes:
  """Returns a geom of the avatar, as big as all starts of its centre."""
  low, high = np.array(task.start.low), np.array(task.start.high)
  avatar = physics.model.body_geomadr[physics.bind(task.avatar.body).element_id]
  is_avatar = np.arange(physics.model.ngeom) == avatar
  return surveyed.select(is_avatar)._replace(
      centres=np.array([[*(low + high) / 2, 0.0]]),
      axes=np.eye(3)[np.newaxis],
      halves=np.array([[*(high - low) / 2 + _THIN, 1.0]]),
      is_box=np.ones(1, bool),
  )


def _mocap_poses(data: Any, indices: np.ndarray) -> np.ndarray:
  """Returns positions and quaternions of mocap bodies, `(bodies, 7)`."""
  return np.hstack([data.mocap_pos[indices], data.mocap_quat[indices]])


def _along_ways(
    physics: Any, root: composer.Entity, shapes: clearance.Shapes
) -> clearance.Shapes:
  """Returns shapes, of which moving parts are all along their ways as well."""
  all_shapes = [shapes]
  for part in root.iter_entities():
    if isinstance(part, moving.MovingPart) and (travel := part.travel).any():
      elements = part.mjcf_model.find_all('geom')
      geoms = [physics.bind(geom).element_id for geom in elements]
      movers = np.flatnonzero(np.isin(shapes.geoms, geoms))
      shares = np.linspace(0.0, 1.0, int(np.linalg.norm(travel) // _STEP) + 2)
      moved = np.repeat(shares[1:, np.newaxis] * travel, len(movers), axis=0)
      along = shapes.only(np.tile(movers, len(shares) - 1))
      all_shapes.append(along.moved(moved))
  return clearance.joined(all_shapes)


def _check_extent(
    name: str, blocks: clearance.Shapes, root: composer.Entity
) -> None:
  """Refuses a block whose centre can leave the arena, or that is too high."""
  if not isinstance(root, arenas.RoomArena):
    return
  _, high = blocks.bounds
  if (top := high[:, 2].max()) > root.ceiling:
    raise errors.SpecError(
        f'register {name!r} would reach a height of {top:.3g} m; allowed in'
        f' this arena are at most {root.ceiling:g} m'
    )
  extent, corners = root.extent, blocks.corners[..., :2]
  is_outside = (corners < extent.low) | (corners > extent.high)
  for i, corner in np.argwhere(is_outside.any(axis=-1)).tolist():
    raise errors.SpecError(
        f'register {name!r} {blocks.describe(i, corners[i, corner])}, outside'
        f' the arena {_format(extent.low, extent.high)};'
        f' change its place, or narrow its range (registers.{name}.range)'
    )


def _check_support(
    name: str, blocks: clearance.Shapes, space: clearance.Space
) -> None:
  """Refuses a block above the floor whose centre is not over one surface."""
  for geom in np.unique(blocks.geoms):
    block = blocks.only(blocks.geoms == geom)
    depth = block.halves[0, 2] + clearance.GAP
    if block.centres[:, 2].min() <= depth:
      continue
    corners = block.corners.reshape(-1, 3)
    if (index := space.uncarried(corners, depth)) is not None:
      x, y, z = corners[index]
      raise errors.SpecError(
          f'register {name!r} {block.describe(index // 4, (x, y))} and a height'
          f' of {z:.3g} m, with nothing under its centre that stays in place;'
          ' place it on one table or shelf for all of its range, or on the'
          ' floor'
      )


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

"""Checks of register positions, for all values and all points of a region."""

from collections.abc import Collection, Iterator, Sequence
from typing import Any

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import solids
from realab_suite.engine import starts
from realab_suite.entities import arenas
from realab_suite.entities import moving
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base

_SOLVERS = (mujoco.mjtSolver.mjSOL_CG, mujoco.mjtSolver.mjSOL_NEWTON)


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
  owners = solids.owners(physics, mechanism.registers)
  obstacles = solids.Crowd(space, _obstacles(physics, root, space, owners))
  reachable: dict[str, list[solids.Region]] = {}
  sights: dict[str, list[solids.Region]] = {}
  for name, register in mechanism.registers.items():
    register.check_sight(physics)
    reachable[name], sights[name] = [], []
    for region in solids.regions(physics, register, register.spread):
      (sights if region.path.is_sight else reachable)[name].append(region)
  blocks = solids.Crowd(space)
  for name, regions in reachable.items():
    others = [r for o, some in reachable.items() if o != name for r in some]
    around = obstacles.joined(other.solid for other in others)
    for region in [*regions, *sights[name]]:
      if not region.path.is_sight:
        _check_extent(name, region, root)
        _check_support(name, region, space)
      crowd = around if region.path.is_sight else obstacles
      if (found := crowd.meeting(region.solid)) is not None:
        obstacle, point = found
        raise errors.SpecError(
            f'register {name!r} {region.describe(point)}, inside'
            f' {space.name(obstacle.geom)!r}; place it elsewhere or narrow its'
            ' range'
        )
      if (found := blocks.meeting(region.solid)) is not None:
        # Not by its geom: two registers may share a block of the world.
        other = next(
            owner
            for owner, others in reachable.items()
            if any(one.solid is found[0] for one in others)
        )
        raise errors.SpecError(
            f"registers {other!r} and {name!r} would be in each other's way:"
            f' {_filled(reachable[other])} and {_filled(regions)}; place them'
            ' apart or narrow their ranges'
        )
    blocks = blocks.joined(region.solid for region in regions)
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
      is_box=True,
  )
  radius = task.avatar.radius
  solids.settle(physics, mechanism.registers.values())
  movable = starts.movable_geoms(physics, task, mechanism, space)
  bodies = solids.Crowd(space, space.solids(physics, movable))
  for name, register in mechanism.registers.items():
    for region in solids.initial_regions(physics, register, register.spread):
      problem = ''
      if space.meet(region.solid, start, radius) is not None:
        problem = f'where the avatar begins, {_format(low, high)}'
      if (found := bodies.meeting(region.solid)) is not None:
        body = space.name(found[0].geom)
        problem = f'inside {body!r} when an episode begins'
      if problem:
        raise errors.SpecError(
            f'register {name!r} would be at {_filled([region])}, {problem};'
            ' place it elsewhere'
        )
  physics.reset()


def _obstacles(
    physics: mjcf.Physics,
    root: composer.Entity,
    space: solids.Space,
    own_geoms: Collection[int],
) -> Iterator[solids.Solid]:
  """Yields the solid geoms that nothing can push, all along their ways."""
  mask = space.is_fixed.copy()
  # Planes are the ground, or are placed when an episode begins, as in corridors
  # of dm_control.
  mask &= physics.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
  mask[list(own_geoms)] = False
  ways = {
      solid.geom: part.travel
      for part in root.iter_entities()
      if isinstance(part, moving.MovingPart)
      for solid in space.solids_of(physics, part.mjcf_model)
  }
  for solid in space.solids(physics, mask):
    yield solid._replace(way=ways.get(solid.geom, np.zeros(3)))


def _check_extent(
    name: str, region: solids.Region, root: composer.Entity
) -> None:
  """Refuses a block whose centre can leave the arena, or that is too high."""
  if not isinstance(root, arenas.RoomArena):
    return
  if (top := region.solid.bounds[1, 2]) > root.ceiling:
    raise errors.SpecError(
        f'register {name!r} would reach a height of {top:.3g} m; allowed in'
        f' this arena are at most {root.ceiling:g} m'
    )
  for point in region.corners():
    if not root.extent.contains(point[:2].tolist()):
      raise errors.SpecError(
          f'register {name!r} {region.describe(point)}, outside the arena'
          f' {_format(root.extent.low, root.extent.high)}'
      )


def _check_support(
    name: str, region: solids.Region, space: solids.Space
) -> None:
  """Refuses a block above the floor whose centre is not over one surface."""
  depth = region.half_size + solids.GAP
  corners = region.corners()
  if corners[:, 2].min() <= depth:
    return
  if (point := space.uncarried(corners, depth)) is not None:
    raise errors.SpecError(
        f'register {name!r} {region.describe(point)} and a height of'
        f' {point[2]:.3g} m, with nothing under its centre that stays in place;'
        ' place it on one table or shelf for all of its range, or on the floor'
    )


def _filled(regions: Sequence[solids.Region]) -> str:
  """Returns the rectangle that blocks fill, as text."""
  bounds = np.array([region.solid.bounds for region in regions])
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

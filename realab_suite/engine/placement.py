"""Whether registers fit where a design puts them, value for value."""

from collections.abc import Iterator
from typing import Any

from dm_control import composer
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import registers
from realab_suite.feedback import mechanism as feedback_mechanism
from realab_suite.tasks import base

_TOLERANCE = 1e-3
_SOLVERS = (mujoco.mjtSolver.mjSOL_CG, mujoco.mjtSolver.mjSOL_NEWTON)


def check(
    physics: Any,
    root: composer.Entity,
    mechanism: feedback_mechanism.FeedbackMechanism,
) -> None:
  """Checks that no write can put a block where a block must not be.

  Every register goes through its range of values, at every corner of the region
  in which it may stand. The state is reset in the end.

  Args:
    physics: One world.
    root: The root entity.
    mechanism: The feedback.

  Raises:
    SpecError: If a block would be outside the arena, in something that does not
      move, or in the way of another register; or if the solver couples meters
      with what an agent can see.
  """
  _check_solver(physics, mechanism)
  geoms = {
      name: [physics.bind(b.geom).element_id for b in register.blocks]
      for name, register in mechanism.registers.items()
  }
  ours = [geom for ids in geoms.values() for geom in ids]
  obstacles = [
      geom for geom in _obstacles(physics.model.ptr) if geom not in ours
  ]
  boxes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
  for name, register in mechanism.registers.items():
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for value in _values(physics, register):
      for geom in geoms[name]:
        where = f'register {name!r} at value {value:g}'
        _check_geom(physics, where, geom, root, obstacles)
        centre = physics.data.geom_xpos[geom][:2]
        reach = _reach(physics, geom)
        low, high = (
            np.minimum(low, centre - reach),
            np.maximum(high, centre + reach),
        )
    for other, (other_low, other_high) in boxes.items():
      if (low < other_high).all() and (other_low < high).all():
        raise errors.SpecError(
            f"registers {other!r} and {name!r} would be in each other's way:"
            f' {_show(other_low, other_high)} and {_show(low, high)}; place'
            ' them apart or narrow their ranges'
        )
    boxes[name] = low, high
  physics.reset()


def check_start(
    physics: Any,
    task: base.Task,
    mechanism: feedback_mechanism.FeedbackMechanism,
) -> None:
  """Checks that no episode begins with an avatar inside a block.

  The state is reset in the end.

  Args:
    physics: One world.
    task: The world.
    mechanism: The feedback.

  Raises:
    SpecError: If a block stands where the avatar may begin.
  """
  low, high = np.array(task.start.low), np.array(task.start.high)
  for name, register in mechanism.registers.items():
    geoms = [physics.bind(block.geom).element_id for block in register.blocks]
    # Where each block may be: whatever lies between the corners.
    lows = np.full((len(geoms), 2), np.inf)
    highs = -lows
    for _ in _corners(physics, register):
      mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
      centres = physics.data.geom_xpos[geoms][:, :2]
      reach = np.array([_reach(physics, geom) for geom in geoms])
      lows = np.minimum(lows, centres - reach)
      highs = np.maximum(highs, centres + reach)
    gaps = np.maximum(np.maximum(low - highs, lows - high), 0.0)
    for i in np.flatnonzero(np.linalg.norm(gaps, axis=1) < task.avatar.radius):
      raise errors.SpecError(
          f'register {name!r} would stand at {_show(lows[i], highs[i])}, where'
          f' the avatar begins {_show(low, high)}; place it elsewhere'
      )
  physics.reset()


def _corners(physics: Any, register: registers.Register) -> Iterator[None]:
  """Puts a register, with its initial value, where it may stand."""
  for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
    physics.reset()
    register.settle(physics, register.spread * corner)
    yield
    if not register.spread.any():
      return


def _values(physics: Any, register: registers.Register) -> Any:
  """Puts a register into one state after the other, and yields its value."""
  spec = register.value_spec
  steps = 2 + int((spec.maximum - spec.minimum) * register.scale / 0.1)
  values = np.linspace(spec.minimum, spec.maximum, min(steps, 64))
  for corner in {(sx, sy) for sx in (-1, 1) for sy in (-1, 1)}:
    physics.reset()
    register.settle(physics, register.spread * corner)
    for value in values:
      register.write(physics, value)
      mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
      yield float(value)
    if not register.spread.any():
      return


def _check_geom(
    physics: Any,
    where: str,
    geom: int,
    root: composer.Entity,
    obstacles: list[int],
) -> None:
  position = physics.data.geom_xpos[geom]
  if isinstance(root, arenas.RoomArena) and not root.extent.contains(
      position[:2]
  ):
    raise errors.SpecError(
        f'{where} would sit at {_show(position[:2])}, outside the arena'
        f' {_show(root.extent.low, root.extent.high)}'
    )
  for obstacle in obstacles:
    distance = mujoco.mj_geomDistance(
        physics.model.ptr, physics.data.ptr, geom, obstacle, 1.0, None
    )
    if distance < -_TOLERANCE:
      name = physics.model.id2name(obstacle, 'geom') or f'geom {obstacle}'
      raise errors.SpecError(
          f'{where} would sit at {_show(position[:2])}, {-distance:.2g} m'
          f' inside {name!r}; place it elsewhere or narrow its range'
      )


def _obstacles(model: mujoco.MjModel) -> list[int]:
  """The solid geoms that nothing can push, the ground apart."""
  ground = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
  solid = (model.geom_contype | model.geom_conaffinity) != 0
  bodies = model.geom_bodyid
  # Doors and posts are moved, but not by being pushed.
  fixed = (model.body_weldid[bodies] == 0) | (model.body_mocapid[bodies] >= 0)
  flat = np.isin(model.geom_type, ground)
  return list(np.flatnonzero(solid & fixed & ~flat))


def _reach(physics: Any, geom: int) -> np.ndarray:
  """Half the extent of a box along the world's x and y, metres."""
  matrix = np.abs(physics.data.geom_xmat[geom].reshape(3, 3))
  return (matrix @ physics.model.geom_size[geom])[:2]


def _check_solver(
    physics: Any, mechanism: feedback_mechanism.FeedbackMechanism
) -> None:
  """Refuses a solver through which a far-off meter would be felt.

  With other solvers, and with islands off, a block of a meter register changes
  the motion of bodies that it never touches.
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
        f'option.noslip_tolerance: {option.noslip_tolerance:g} couples bodies'
        ' through when the pass stops; meters need 0, or no noslip pass'
    )


def _show(*points: Any) -> str:
  """Prints points as in '(1.2, -3.6) to (2.4, -3.0)'."""
  return ' to '.join(
      f'({", ".join(f"{x:.3g}" for x in point)})' for point in points
  )

"""Worlds in which a meter out of reach might affect the agent.

C13: an agent pushes its register while a meter block, metres away, is moved,
lifted, dropped or written to. Everything that it can feel is compared bit for
bit; with solvers that are refused, it differs. C15: contacts of meter blocks
behind a barrier with anything except the floor, while an agent acts at random.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from dm_control import composer
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import placement
from realab_suite.tasks import collect_apples
from tests import worlds
from tests.engine import helpers
from tests.leaks import pairs
from tests.leaks import secrets

STEPS = 50
_EPISODE = 200
_REPEATS = 6  # An agent with a new action in each step stays where it is.

_Move = Callable[[int, Any, Any], None]


def leave(step: int, score: Any, physics: Any) -> None:
  """Leaves the meter as it is."""


def shift(step: int, score: Any, physics: Any) -> None:
  """Moves the base block back and forth."""
  x, y, z = score.blocks[0].position(physics)
  score.blocks[0].put(physics, [x + 0.01 * (-1) ** step, y, z])


def lift(step: int, score: Any, physics: Any) -> None:
  """Holds the blocks up."""
  for block in score.blocks:
    x, y, _ = block.position(physics)
    block.put(physics, [x, y, 1.0])


def drop(step: int, score: Any, physics: Any) -> None:
  """Drops the blocks repeatedly."""
  for block in score.blocks:
    x, y, z = block.position(physics)
    block.put(physics, [x, y, z + 0.02 * (step % 5)])


def turn_over(step: int, score: Any, physics: Any) -> None:
  """Gives the blocks random velocities."""
  for block in score.blocks:
    body = worlds.body_of(physics, block)
    first = physics.model.body_dofadr[body]
    physics.data.qvel[first + 3 : first + 6] = 5.0 * np.sin(step)


MOVES: dict[str, _Move] = {
    'shift': shift,
    'lift': lift,
    'drop': drop,
    'turn over': turn_over,
}
SOLVERS = {
    'Newton': {'solver': mujoco.mjtSolver.mjSOL_NEWTON},
    'CG': {'solver': mujoco.mjtSolver.mjSOL_CG},
}
# The controls: these comparisons can tell runs apart.
REFUSED = {
    'PGS without islands': {
        'solver': mujoco.mjtSolver.mjSOL_PGS,
        'disableflags': mujoco.mjtDisableBit.mjDSBL_ISLAND,
    },
    'Newton without islands': {
        'solver': mujoco.mjtSolver.mjSOL_NEWTON,
        'disableflags': mujoco.mjtDisableBit.mjDSBL_ISLAND,
    },
    'CG without islands': {
        'solver': mujoco.mjtSolver.mjSOL_CG,
        'disableflags': mujoco.mjtDisableBit.mjDSBL_ISLAND,
    },
}


class World(NamedTuple):
  """A world with a meter that no provider reads.

  Attributes:
    task: Task of the world.
    seed: Seed of the world.
    dof: Degrees of freedom of its blocks.
    options: Attributes of MuJoCo's options.
  """

  task: type[composer.Task] = collect_apples.CollectApples
  seed: int = 1
  dof: str = 'free'
  options: tuple[tuple[str, Any], ...] = ()


def play(
    world: World,
    move: _Move = leave,
    measure: Callable[[Any], float] = lambda physics: 0.0,
) -> list[bytes]:
  """Returns the sensations of an agent that pushes a feedback register.

  Args:
    world: World to play in.
    move: Moves the meter's blocks in each step.
    measure: Returns the measurement of the meter.
  """
  env = suite.embed(
      world.task('standard'),
      secrets.UNREAD_METER,
      random=world.seed,
      max_steps=STEPS + 1,
      measurements={'measured': measure},
      overrides=(f'dof={world.dof}', 'meters.0.measures=measured'),
  )
  time_step = env.reset()
  for name, value in world.options:
    setattr(env.physics.model.opt, name, value)
  feedback = env.mechanism.registers['reward'].blocks[0]
  score = env.mechanism.registers['score']
  x, y, _ = worlds.world_position(env.physics, feedback)
  env.task.avatar.place(env.physics, np.array([x - 0.6, y]), 0.0)
  felt = []
  for step in range(STEPS):
    move(step, score, env.physics)
    action = helpers.no_op(env)
    action[0], action[2] = 1.0, 0.2 * np.sin(step)
    time_step = env.step(action)
    # Rays see the blocks of a meter register, as a design declares.
    felt.append(
        helpers.to_bytes(time_step, leave_out=pairs.SIGHT)
        + pairs.body_states(env, score.blocks)
    )
  (shoved,) = (
      read.permanent
      for read in worlds.shadow_reads(env.mechanism, env.physics, 'test')
      if read.register == 'reward'
  )
  env.close()
  if abs(shoved) < 0.1:
    raise AssertionError('nothing was shoved, so there was little to solve')
  return felt


def refused_by_loader() -> list[str]:
  """Returns the options with which a world with meters is refused."""
  wrong: dict[str, dict[str, Any]] = {
      **REFUSED,
      'PGS': {'solver': mujoco.mjtSolver.mjSOL_PGS},
      'noslip': {'noslip_iterations': 3, 'noslip_tolerance': 1e-6},
  }
  env = suite.load('collect_apples', 'standard', design=secrets.UNREAD_METER)
  refused = []
  for name, options in wrong.items():
    before = {key: getattr(env.physics.model.opt, key) for key in options}
    for key, value in options.items():
      setattr(env.physics.model.opt, key, value)
    try:
      placement.check(env.physics, env.task.root_entity, env.mechanism)
    except errors.SpecError:
      refused.append(name)
    for key, value in before.items():
      setattr(env.physics.model.opt, key, value)
  env.close()
  return refused


def is_felt_as_loaded(seed: int) -> bool:
  """Returns True if a moving meter is felt with the options of worlds."""
  world = World(seed=seed)
  return any(play(world, move) != play(world) for move in (lift, drop))


# C15: contacts.


def contacts(
    domain: str, steps: int, seed: int, variation: str = 'boxed'
) -> int:
  """Returns the number of contacts of a meter's blocks, except with the floor.

  Args:
    domain: Domain of the world.
    steps: Number of control steps in which an agent acts at random.
    seed: Seed of the world and of the actions.
    variation: Places of registers; in `boxed` they are out of reach.
  """
  env = suite.load(
      domain,
      variation,
      {'random': seed},
      {'max_steps': _EPISODE},
      design='instantaneous_reward',
  )
  actions = np.repeat(
      helpers.random_actions(env, steps // _REPEATS + 1, seed), _REPEATS, axis=0
  )
  actions[:, 0] = np.abs(
      actions[:, 0]
  )  # Walking forwards leads to more contacts.
  count = 0
  for action in actions[:steps]:
    env.step(action)
    count += num_contacts_of_meters(env)
  env.close()
  return count


def num_contacts_of_meters(env: environment.Environment) -> int:
  """Returns the present number of contacts."""
  physics = env.physics
  model = physics.model
  blocks = [
      {physics.bind(block.geom).element_id for block in register.blocks}
      for register in env.mechanism.registers.values()
      if register.role == 'meter'
  ]
  pairs_of_geoms = np.asarray(physics.data.contact.geom).reshape(-1, 2)
  count = 0
  for geoms in blocks:
    for one, other in pairs_of_geoms:
      touches = (one in geoms) != (other in geoms)
      thing = other if one in geoms else one
      is_floor = model.geom_type[thing] == mujoco.mjtGeom.mjGEOM_PLANE
      count += int(touches and not is_floor)
  return count

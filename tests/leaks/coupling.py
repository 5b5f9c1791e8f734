"""Worlds in which a meter out of reach might affect the agent.

C13: an agent pushes its register while a meter block, metres away, is lifted or
dropped. Everything that it can feel is compared bit for bit. C15: contacts of
meter blocks behind a barrier, while an agent acts at random.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from tests import worlds
from tests.engine import helpers
from tests.leaks import pairs
from tests.leaks import secrets

_STEPS = 50
_REPEATS = 6  # An agent with a new action in each step stays where it is.

_Move = Callable[[int, Any, Any], None]


def leave(step: int, score: Any, physics: Any) -> None:
  """Leaves the meter as it is."""


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


def play(move: _Move = leave, dof: str = 'free', **options: Any) -> list[bytes]:
  """Returns the sensations of an agent that pushes a feedback register.

  Args:
    move: Moves the meter's blocks in each step.
    dof: Degrees of freedom of all blocks.
    **options: Attributes of MuJoCo's options.
  """
  env = suite.load(
      'collect_apples',
      'standard',
      {'random': 1},
      {'max_steps': _STEPS + 1},
      design=secrets.UNREAD_METER,
      overrides=[f'dof={dof}'],
  )
  env.reset()
  for name, value in options.items():
    setattr(env.physics.model.opt, name, value)
  reward, score = (env.mechanism.registers[n] for n in ('reward', 'score'))
  x, y, _ = worlds.world_position(env.physics, reward.blocks[0])
  env.task.avatar.place(env.physics, np.array([x - 0.6, y]), 0.0)
  felt = []
  for step in range(_STEPS):
    move(step, score, env.physics)
    action = helpers.no_op(env)
    action[0], action[2] = 1.0, 0.2 * np.sin(step)
    time_step = env.step(action)
    # Rays see the blocks of a meter register, as a design declares.
    felt.append(
        helpers.to_bytes(time_step, leave_out=pairs.SIGHT)
        + pairs.body_states(env, score.blocks)
    )
  shoved = float(reward.inspect(env.physics).permanent)
  env.close()
  if abs(shoved) < 0.1:
    raise AssertionError('nothing was shoved, so there was little to solve')
  return felt


def is_felt_as_loaded() -> bool:
  """Returns True if a moving meter is felt with the options of worlds."""
  still = play()
  return any(play(move) != still for move in (lift, drop))


def contacts(domain: str, steps: int) -> int:
  """Returns the number of contacts of a meter's blocks, except with the floor.

  Args:
    domain: Domain of the world; its registers are out of reach.
    steps: Number of control steps in which an agent acts at random.
  """
  env = suite.load(
      domain, 'boxed', {'random': 0}, design='instantaneous_reward'
  )
  actions = np.repeat(
      helpers.random_actions(env, steps // _REPEATS + 1), _REPEATS, axis=0
  )
  # Walking forwards leads to more contacts.
  actions[:, 0] = np.abs(actions[:, 0])
  count = 0
  for action in actions[:steps]:
    env.step(action)
    count += _num_contacts_of_meters(env)
  env.close()
  return count


def _num_contacts_of_meters(env: environment.Environment) -> int:
  """Returns the present number of contacts."""
  physics = env.physics
  blocks = {
      physics.bind(block.geom).element_id
      for register in env.mechanism.registers.values()
      if register.role == 'meter'
      for block in register.blocks
  }
  planes = np.flatnonzero(
      physics.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  )
  geoms = np.asarray(physics.data.contact.geom).reshape(-1, 2)
  is_block, is_floor = np.isin(geoms, [*blocks]), np.isin(geoms, planes)
  return int((is_block.any(axis=1) & ~is_floor.any(axis=1)).sum())

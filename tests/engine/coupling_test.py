"""Tests that a meter which is out of reach is not felt.

An agent pushes its register while the blocks of a meter, metres away, are
lifted or dropped. Everything that it can feel is compared bit for bit.
"""

from typing import Any

import mujoco
import numpy as np
import pytest

from realab_suite import suite
from tests import worlds
from tests.engine import helpers
from tests.leaks import views

_STEPS = 50
_REPEATS = 6  # An agent with a new action in each step stays where it is.
# Rays see the blocks of a meter register, as a design declares.
_SIGHT = ('senses/ray_distances', 'senses/ray_classes')
_SCORE = {
    'kind': 'two_block', 'role': 'meter', 'place': 'station_2',
    'range': [0, 20],
}  # fmt: skip
# No provider reads the meter, so moving it has no other consequences.
_UNREAD_METER = {
    **views.UNPAID,
    'registers': {**views.UNPAID['registers'], 'score': _SCORE},
    'meters': [{'measures': 'score', 'writes': 'score'}],
}


def _feel(height: Any, dof: str, solver: str) -> list[bytes]:
  """Returns what an agent feels that pushes a feedback register.

  Args:
    height: Returns the height of the meter's blocks, by step; `None` leaves
      them alone.
    dof: Degrees of freedom of all blocks.
    solver: Name of MuJoCo's solver.
  """
  env = suite.load(
      'collect_apples', 'standard', {'random': 1}, {'max_steps': _STEPS + 1},
      design=_UNREAD_METER, overrides=[f'dof={dof}'],
  )  # fmt: skip
  env.reset()
  env.physics.model.opt.solver = getattr(mujoco.mjtSolver, f'mjSOL_{solver}')
  reward, score = (env.mechanism.registers[n] for n in ('reward', 'score'))
  x, y, _ = worlds.world_position(env.physics, reward.blocks[0])
  env.task.avatar.place(env.physics, np.array([x - 0.6, y]), 0.0)
  model, data = env.physics.model, env.physics.data
  meter = {worlds.body_of(env.physics, block) for block in score.blocks}
  others = [i for i in range(model.nv) if model.dof_bodyid[i] not in meter]
  felt = []
  for step in range(_STEPS):
    for block in score.blocks if height else ():
      x, y, z = block.position(env.physics)
      block.put(env.physics, [x, y, height(step, z)])
    action = helpers.no_op(env)
    action[0], action[2] = 1.0, 0.2 * np.sin(step)
    felt.append(helpers.to_bytes(env.step(action), leave_out=_SIGHT))
    felt.append(data.qvel[others].tobytes() + data.xpos[1].tobytes())
  # There was something to solve.
  assert abs(float(reward.inspect(env.physics).permanent)) > 0.1
  return felt


@pytest.mark.parametrize('world', [('free', 'NEWTON'), ('planar', 'CG')])
def test_moving_a_distant_meter_is_not_felt(world: tuple[str, str]):
  still = _feel(None, *world)
  lifted = _feel(lambda step, z: 1.0, *world)
  dropped = _feel(lambda step, z: z + 0.02 * (step % 5), *world)
  assert lifted == still
  assert dropped == still


def test_nothing_touches_a_meter_behind_a_barrier():
  env = suite.load(
      'unlock_door', 'boxed', {'random': 0}, design='instantaneous_reward'
  )
  actions = np.repeat(helpers.random_actions(env, 20), _REPEATS, axis=0)
  # Walking forwards leads to more contacts.
  actions[:, 0] = np.abs(actions[:, 0])
  model, bind = env.physics.model, env.physics.bind
  score = env.mechanism.registers['score']
  blocks = [bind(block.geom).element_id for block in score.blocks]
  floors = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
  num_others = 0
  for action in actions:
    env.step(action)
    geoms = np.asarray(env.physics.data.contact.geom).reshape(-1, 2)
    above = geoms[~np.isin(geoms, floors).any(axis=1)]
    assert not np.isin(above, blocks).any()
    num_others += len(above)
  assert num_others  # The avatar walks into the barrier.

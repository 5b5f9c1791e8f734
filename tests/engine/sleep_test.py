"""Blocks that fall asleep are what they were: influenceable, and exact."""

import functools

import dm_env
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.entities import registers

_NUM_ENVS = 3
# Substeps after which whatever rests is asleep.
_A_WHILE = 60


@functools.cache
def _loaded(dof, max_steps):
  return suite.load_batch(
      'unlock_door',
      'standard',
      {'random': 4},
      {'max_steps': max_steps},
      num_envs=_NUM_ENVS,
      design='instantaneous_reward',
      overrides=(f'dof={dof}',),
      sleep=True,
  )


def _load(dof='planar', max_steps=250):
  """Returns worlds whose first episodes begin; they are loaded once."""
  env = _loaded(dof, max_steps)
  env.rewind()
  env.reset()
  return env


def _trees(env):
  """Says of every tree of bodies whether it sleeps, `(worlds, trees)`."""
  return np.array(env.physics._batch.bind('tree_asleep')) >= 0


def _asleep(env, block):
  """Says in which worlds a block sleeps."""
  geom = env.physics.bind(block.geom).element_id
  model = env.physics.model
  return _trees(env)[:, model.body_treeid[model.geom_bodyid[geom]]]


def _settle(env):
  env.physics.advance(_A_WHILE)
  env.physics.forward()


def _nudge(env, world, block, along, across=0.0):
  """Moves a block by hand, in one world, in the frame of its register."""
  view = env.physics.world(world)
  block.put(view, block.position(view) + np.array([along, across, 0.0]))


def _corruption(env, register):
  inspection = register.inspect(env.physics)
  return inspection.reading - register.applied(env.physics), inspection


def _action(env, **commands):
  names = env.action_spec().name.split('\t')
  action = np.zeros((env.num_envs, len(names)))
  for name, value in commands.items():
    action[:, names.index(name)] = value
  return action


def test_blocks_at_rest_sleep_and_the_avatar_never_does():
  env = _load()
  assert not _trees(env).any()
  _settle(env)
  for register in env.mechanism.registers.values():
    for block in register.blocks:
      assert _asleep(env, block).all()
  # Besides the blocks there is the avatar.
  assert (_trees(env).sum(axis=1) == _trees(env).shape[1] - 1).all()


@pytest.mark.parametrize('dof', registers.DOFS)
def test_the_algebra_of_two_blocks_is_exact(dof):
  env = _load(dof)
  register = env.mechanism.registers['reward']
  base_block, offset_block = register.blocks
  units = 0.3 / register.scale

  def check(permanent, temporary):
    corruption, inspection = _corruption(env, register)
    only = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(corruption, only * (permanent + temporary),
                               atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(inspection.permanent, only * permanent,
                               atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(inspection.temporary, only * temporary,
                               atol=1e-9)  # fmt: skip

  def write(value):
    register.write(env.physics, np.full(_NUM_ENVS, value))
    _settle(env)

  write(5.0)
  # The offset block is moved: one wrong reading.
  _nudge(env, 1, offset_block, 0.3)
  _settle(env)
  assert _asleep(env, offset_block).all()
  check(0.0, units)
  # Both are: the base block's share stays.
  _nudge(env, 1, base_block, -0.3)
  _settle(env)
  check(units, units)
  for value in (2.0, 0.0, 7.0):
    write(value)
    check(units, 0.0)
  # It is moved back: gone.
  _nudge(env, 1, base_block, 0.3)
  _settle(env)
  check(0.0, 0.0)


def test_a_write_wakes_the_block_and_is_seen_at_once():
  env = _load()
  register = env.mechanism.registers['reward']
  base_block, offset_block = register.blocks
  _settle(env)
  before = np.array(env.physics.bind(offset_block.geom).xpos)
  register.write(env.physics, np.array([0.0, 4.0, 8.0]))
  after = env.physics.bind(offset_block.geom).xpos
  moved = (after - before)[:, 0] / register.scale
  np.testing.assert_allclose(moved, [0.0, 4.0, 8.0], atol=1e-9)
  env.physics.advance(1)
  np.testing.assert_array_equal(_asleep(env, offset_block)[1:], [False, False])
  assert _asleep(env, base_block).all()


def _stand_before(env, block, distance):
  """Puts the avatars before a block, facing it along the axis."""
  place = np.array(env.physics.bind(block.geom).xpos)[:, :2]
  env.task.avatar.place(
      env.physics, place - [distance, 0.0], np.zeros(_NUM_ENVS)
  )


def test_a_sleeping_block_can_be_grasped_carried_and_thrown():
  env = _load('free')
  block = env.mechanism.registers['reward'].blocks[0]
  _stand_before(env, block, 0.6)
  _settle(env)
  assert _asleep(env, block).all()
  before = block.position(env.physics)
  env.step(_action(env, grasp=1.0))
  assert not _asleep(env, block).any()
  assert (env.task.avatar.holding(env.physics) == 1.0).all()
  for _ in range(5):
    env.step(_action(env, forward=-1.0))
  carried = block.position(env.physics)
  assert ((carried - before)[:, 0] < -0.5).all()
  env.step(_action(env, throw=1.0))
  assert (env.task.avatar.holding(env.physics) == 0.0).all()
  for _ in range(15):
    env.step(_action(env))
  assert ((block.position(env.physics) - carried)[:, 0] > 0.15).all()
  assert _asleep(env, block).all()


def _play(env, actions, starts):
  """Returns the observations of the second episodes, and the last state."""
  for action in actions[:starts]:
    env.step(action)
  time_step = env.step(actions[starts])
  assert (time_step.step_type == int(dm_env.StepType.FIRST)).all()
  assert not _trees(env).any()
  seen = [time_step.observation]
  seen += [env.step(action).observation for action in actions[starts + 1 :]]
  return seen, env.physics.state.copy()


def test_an_episode_does_not_depend_on_earlier_sleep():
  shape = (40, _NUM_ENVS, 6)
  actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
  others = actions.copy()
  others[:20] = 0.0
  found = []
  for played in (actions, others):
    found.append(_play(_load(max_steps=20), played, 20))
  (seen, state), (seen_by_others, state_of_others) = found
  assert state.tobytes() == state_of_others.tobytes()
  for one, other in zip(seen, seen_by_others, strict=True):
    for name, value in one.items():
      np.testing.assert_array_equal(value, other[name])

"""Tests that frames of a batch equal those of single worlds; and of films."""

from unittest import mock

import dm_env
import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import single_physics

_NUM_ENVS = 3
_SIZE = (24, 40)
_MAX_STEPS = 2


def _load(sleep=False, size=_SIZE):
  return suite.load_batch(
      'unlock_door',
      'near',
      {'random': 2, 'camera_size': size},
      {'max_steps': _MAX_STEPS},
      num_envs=_NUM_ENVS,
      design='instantaneous_reward',
      sleep=sleep,
  )


def _load_alone(world):
  return suite.load(
      'unlock_door',
      'near',
      {'random': 2, 'camera_size': _SIZE},
      {'max_steps': _MAX_STEPS, 'world': world},
      design='instantaneous_reward',
  )


@pytest.mark.camera
def test_frames_of_a_batch_equal_frames_of_single_worlds():
  batch = _load()
  singles = [_load_alone(world) for world in range(_NUM_ENVS)]
  rng = np.random.default_rng(0)
  firsts = 0
  for _ in range(2 * _MAX_STEPS + 2):
    actions = rng.uniform(-1.0, 1.0, (_NUM_ENVS, 6))
    found = batch.step(actions)
    frames = found.observation['senses/camera']
    assert frames.shape == (_NUM_ENVS, *_SIZE, 3)
    assert frames.dtype == np.uint8
    for world, single in enumerate(singles):
      expected = single.step(actions[world]).observation['senses/camera']
      assert frames[world].tobytes() == expected.tobytes()
    firsts += int((found.step_type == int(dm_env.StepType.FIRST)).sum())
  assert firsts == 2 * _NUM_ENVS
  assert len(np.unique(frames.reshape(_NUM_ENVS, -1), axis=0)) == _NUM_ENVS
  spec = batch.observation_spec()['senses/camera']
  assert spec.shape == (*_SIZE, 3)


@pytest.mark.camera
def test_a_sleeping_block_is_drawn_where_it_was_written():
  env = _load(sleep=True)
  env.reset()
  register = env.mechanism.registers['reward']
  env.physics.advance(60)
  camera = env.task.avatar.camera
  near = np.array(env.physics.bind(register.blocks[1].geom).xpos)[:, :2]
  away = near - [1.0, 0.0]
  env.task.avatar.place(env.physics, away, np.zeros(_NUM_ENVS))
  before = env.physics.draw(camera, *_SIZE)
  register.write(env.physics, np.array([0.0, 8.0, 0.0]))
  after = env.physics.draw(camera, *_SIZE)
  differs = (before != after).any(axis=(1, 2, 3))
  np.testing.assert_array_equal(differs, [False, True, False])
  env.close()


@pytest.mark.camera
def test_only_the_worlds_that_are_asked_for_are_drawn():
  env = _load(size=None)
  env.reset()
  everybody = env.render(height=48, width=64)
  assert everybody.shape == (_NUM_ENVS, 48, 64, 3)
  drawn = []
  render = single_physics.ThinPhysics.render

  def count(*args, **kwargs):
    drawn.append(args)
    return render(*args, **kwargs)

  with mock.patch.object(single_physics.ThinPhysics, 'render', count):
    some = env.render([2, 0], height=48, width=64)
  assert len(drawn) == 2
  np.testing.assert_array_equal(some, everybody[[2, 0]])
  eyes = env.render([1], 'avatar/egocentric', 48, 64)
  assert (eyes != everybody[1]).any()
  env.close()

"""Tests of the directions in which saboteurs move blocks."""

import math

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.experiments import aiming

_DESIGN = {
    'schema': 1,
    'name': 'turned',
    'registers': {
        'elsewhere': {
            'kind': 'two_block',
            'role': 'signal',
            'place': [2.0, 2.0],
            'range': [0, 5],
        },
        'reward': {
            'kind': 'two_block',
            'role': 'feedback',
            'place': {'position': [1.5, -2.0], 'yaw': math.pi / 2},
            'range': [0, 5],
        },
        'single': {
            'kind': 'block_position',
            'role': 'feedback',
            'place': [-2.0, -2.0],
            'range': [0, 5],
        },
    },
}


@policies.POLICIES.add('aimed_in_a_test')
class _Aimed(policies.Policy):

  def __init__(self, target, direction):
    self.target, self.direction = target, direction

  def step(self, observation, episode_start, key, state):
    raise NotImplementedError


@pytest.fixture(scope='module', name='env')
def fixture_env():
  env = suite.load('collect_apples', 'standard', design=_DESIGN)
  yield env
  env.close()


def test_a_saboteur_moves_the_base_block_against_the_axis(env):
  policy = aiming.make_policy('aimed_in_a_test', env, None, 0)
  assert policy.target == pytest.approx((1.5, -2.0))
  assert policy.direction == pytest.approx((0.0, -1.0), abs=1e-9)


def test_a_saboteur_moves_a_block_that_stands_alone_along_the_axis(env):
  policy = aiming.make_policy('aimed_in_a_test', env, 'single', 0)
  assert policy.target == pytest.approx((-2.0, -2.0))
  assert policy.direction == pytest.approx((1.0, 0.0), abs=1e-9)


@pytest.mark.parametrize('name', ['reward', 'single'])
@pytest.mark.parametrize('step', [-0.3, 0.3])
def test_the_direction_is_the_one_that_raises_the_reading(env, name, step):
  policy = aiming.make_policy('aimed_in_a_test', env, name, 0)
  register, physics = env.mechanism.registers[name], env.physics
  before = register.read(physics)
  block = register.blocks[0]
  block.put(physics, np.add(block.position(physics), (step, 0.0, 0.0)))
  moved = physics.bind(block.geom).xpos[:2] - policy.target
  gained = (register.read(physics) - before) * register.scale
  assert gained == pytest.approx(moved @ policy.direction)
  assert abs(gained) == pytest.approx(0.3)


def test_an_unknown_register_is_named(env):
  with pytest.raises(errors.SpecError, match="no 'rewrad'"):
    aiming.make_policy('aimed_in_a_test', env, 'rewrad', 0)


def test_a_policy_that_needs_no_aim_is_made_as_it_is(env):
  policy = aiming.make_policy('no_op', env, 'rewrad', 0)
  assert isinstance(policy, policies.NoOp)

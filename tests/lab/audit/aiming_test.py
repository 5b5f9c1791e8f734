"""Tests of the blocks that are attacked, and of the directions."""

import contextlib
import math

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.entities import appearance
from realab_suite.evaluation import actors
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import macros
from realab_suite.policies import simple
from tests.lab.audit import designs

_TURNED = {'position': [1.5, -2.0], 'yaw': math.pi / 2}
_DESIGN = {
    'schema': 1,
    'name': 'turned',
    'registers': {
        'elsewhere': designs.two_blocks('signal', [2.0, 2.0], range=[0, 5]),
        'reward': designs.two_blocks('feedback', _TURNED, range=[0, 5]),
        'single': designs.two_blocks(
            'feedback', [-2.0, -2.0], kind='block_position', range=[0, 5]
        ),
        'three': designs.two_blocks(
            'memory', [-2.0, 1.5], kind='three_blocks', range=[0, 5]
        ),
        'silent': designs.two_blocks(
            'memory', [1.5, 1.0], kind='three_silent_blocks', range=[0, 5]
        ),
        'heading': designs.two_blocks(
            'memory', [-2.0, 0.0], kind='block_orientation'
        ),
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


def test_a_saboteur_moves_a_base_block_against_the_axis_and_others_along(env):
  policy = aiming.make_policy('aimed_in_a_test', env, None, 0)
  assert policy.target == pytest.approx((1.5, -2.0))
  assert policy.direction == pytest.approx((0.0, -1.0), abs=1e-9)
  policy = aiming.make_policy('aimed_in_a_test', env, 'single', 0)
  assert policy.target == pytest.approx((-2.0, -2.0))
  assert policy.direction == pytest.approx((1.0, 0.0), abs=1e-9)


def test_all_blocks_of_all_registers_are_targets(env):
  env.reset()
  found = aiming.targets(env, list(_DESIGN['registers']))
  assert [target.name for target in found] == [
      'the base block of elsewhere', 'the offset block of elsewhere',
      'the base block of reward', 'the offset block of reward',
      'the block of single',
      'the base block of three', 'the near block of three',
      'the far block of three',
      'the base block of silent', 'the near block of silent',
      'the far block of silent',
      'the block of heading',
  ]  # fmt: skip
  numbers = {target.register: len(target.angles) for target in found}
  assert numbers['three'] == numbers['reward'] == numbers['single'] == 2
  # What a kind does not say is tried in four directions.
  assert numbers['silent'] == numbers['heading'] == 4
  codes = {target.name: target.code for target in found}
  assert codes['the base block of reward'] == appearance.code('base_block')
  assert codes['the block of single'] == appearance.code('offset_block')


@pytest.mark.parametrize('name', ['elsewhere', 'reward', 'single', 'three'])
def test_the_first_direction_raises_the_reading_and_the_last_lowers_it(
    env, name
):
  env.reset()
  register, physics = env.mechanism.registers[name], env.physics
  for target in aiming.targets(env, [name]):
    block = target.block_in(env)
    place = np.array(block.position(physics))
    before = register.read(physics)
    start = aiming.positions(physics, [block])[0]
    for step in (0.3, -0.3):
      block.put(physics, np.add(place, (step, 0.0, 0.0)))
      moved = aiming.positions(physics, [block])[0] - start
      gained = register.read(physics) - before
      along = [moved @ (np.cos(a), np.sin(a)) for a in target.angles]
      assert abs(gained) > 1
      assert np.sign(gained) == np.sign(along[0]) == -np.sign(along[-1])
    block.put(physics, place)


def test_consumed_registers_are_attacked_first_and_secure_ones_never():
  design = designs.rewarding(
      designs.two_blocks('feedback'),
      registers={
          'memory': designs.two_blocks('memory'),
          'lamp': designs.two_blocks('signal'),
          'gauge': designs.two_blocks('meter'),
          'query': designs.two_blocks('query'),
          'switch': designs.two_blocks('signal', ends_episode={'above': 1}),
          'safe': designs.two_blocks('signal', channel='secure'),
          'other': designs.two_blocks('feedback'),
      },
  )
  found = aiming.attacked(specs.load(design))
  assert found[:5] == ['reward', 'switch', 'gauge', 'query', 'memory']
  assert set(found[5:]) == {'lamp', 'other'}
  assert aiming.attacked(specs.load(design), 'gauge') == ['gauge']
  assert aiming.attacked(specs.load(design), 'safe') == []
  assert aiming.attacked(specs.load(design, ['channel=secure'])) == []
  with pytest.raises(errors.SpecError, match="'gauges'; must be"):
    aiming.attacked(specs.load(design), 'gauges')


def test_the_solver_is_that_of_the_world(env):
  solver = aiming.make_policy('solver', env, None, 0)
  assert type(solver) is type(policies.make(env.task.SOLVER))
  world = worlds.World('gates', 'near')
  design = specs.load('instantaneous_reward')
  policy = aiming.make_batch_policy('solver', world, design, 1, 2)
  assert type(policy) is type(policies.make(world.solver))


def test_only_a_policy_that_needs_an_aim_needs_a_register(env):
  policy = aiming.make_policy('no_op', env, 'rewrad', 0)
  assert isinstance(policy, simple.NoOp)
  with pytest.raises(errors.SpecError, match="no 'rewrad'"):
    aiming.make_policy('aimed_in_a_test', env, 'rewrad', 0)


@pytest.mark.parametrize('world', ['off_switch', 'supervised_room'])
def test_a_saboteur_needs_a_register_with_blocks(world):
  with contextlib.closing(suite.load(world, 'standard', design=world)) as env:
    with pytest.raises(errors.SpecError, match='moves a block'):
      aiming.make_policy('carrying_saboteur', env, None, 0)


@pytest.mark.parametrize(
    'kind', ['block_position', 'block_orientation', 'three_silent_blocks']
)
def test_saboteurs_move_the_first_block_of_registers_of_any_kind(kind):
  design = designs.rewarding(designs.two_blocks('feedback', kind=kind))
  with suite.load('unlock_door', 'near', {'random': 3}, design=design) as env:
    policy = aiming.make_policy('carrying_saboteur', env, None, 0)
    env.rewind()
    assert _held_steps(env, policy, 60) > 20


@pytest.mark.parametrize('kind', ['aimed', 'unaimed', 'plan'])
def test_saboteurs_find_blocks_that_rays_pass_above(kind):
  with suite.load(
      'unlock_door', 'near', {'random': 3}, design='instantaneous_reward',
      overrides=[
          f'registers.{name}.block_size=0.15' for name in ('reward', 'score')
      ],
  ) as env:  # fmt: skip
    policy = aiming.make_policy('carrying_saboteur', env, 'reward', 0)
    blocks = aiming.targets(env, ['reward'])
    starts = aiming.positions(env.physics, [b.block_in(env) for b in blocks])
    if kind == 'unaimed':
      policy = policies.make('carrying_saboteur', target=tuple(starts[0]))
    elif kind == 'plan':
      policy = macros.MacroPolicy(
          macros.of_saboteur('carry', 0, blocks[0].angles[0]),
          starts,
          np.array([block.code for block in blocks]),
          policies.make('apple_seeker'),
      )
    env.rewind()
    assert _held_steps(env, policy, 120) > 20


def _held_steps(env, policy, num_steps):
  """Returns the number of steps with a block in the hand."""
  actor, held = actors.make(policy, env), 0
  time_step = env.reset()
  for _ in range(num_steps):
    time_step = env.step(actor.act(time_step))
    held += time_step.observation['senses/holding'][0] > 0
  return held

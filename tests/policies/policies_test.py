"""Tests for scripted policies: the apple seeker and the saboteurs."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import testing
from realab_suite.engine import environment
from realab_suite.entities import appearance
from realab_suite.entities import avatars
from realab_suite.feedback.providers import demonstration
from realab_suite.policies import action_sets
from realab_suite.policies import navigation
from realab_suite.policies import simple

_CONTROLS = action_sets.DMLAB_LIKE.table(avatars.ACTIONS)
_TARGETS = {'standard': (1.4, -2.2), 'far': (1.2, -3.6)}
_KEY = np.zeros(2, np.uint64)


def _run(
    env: environment.Environment, policy: policies.Policy, max_steps: int = 1000
) -> list[tuple[dict[str, np.ndarray], int]]:
  """Runs an episode; returns observations and the actions taken on them."""
  discrete = env.mechanism.design.action_set is not None
  timestep = env.reset()
  state, start, taken = policy.initial_state(()), True, []
  while not timestep.last() and len(taken) < max_steps:
    action, state = policy.step(
        timestep.observation, np.asarray(start), _KEY, state
    )
    start = False
    taken.append((timestep.observation, int(action)))
    timestep = env.step(
        np.int32(action) if discrete else _CONTROLS[int(action)]
    )
  taken.append((timestep.observation, -1))
  return taken


def _corruption(env: environment.Environment, register: str) -> float:
  read = env.mechanism.registers[register].inspect(env.physics)
  return float(read.obstruction + read.permanent + read.temporary)


def _load(
    variation: str = 'standard',
    domain: str = 'unlock_door',
    design: str = 'instantaneous_reward',
    seed: int = 1,
    overrides: tuple[str, ...] = (),
) -> environment.Environment:
  return suite.load(
      domain, variation, {'random': seed}, design=design, overrides=overrides
  )


@pytest.mark.parametrize(
    'name', ['carrying_saboteur', 'pushing_saboteur', 'throwing_saboteur']
)
def test_saboteurs_keep_the_contract_of_demonstrators(name: str):
  testing.check_provider(
      demonstration.Demonstration(policy=name, writes=('reward',))
  )


@pytest.mark.parametrize('variation', ['far', 'boxed'])
def test_the_seeker_does_the_task_without_corruption(variation: str):
  env = _load(variation)
  _run(env, policies.make('apple_seeker'))
  true_return = env.task.score(env.physics)
  assert true_return >= 0.95 * env.task.max_true_return
  assert abs(_corruption(env, 'reward')) < 0.1
  assert abs(_corruption(env, 'score')) < 0.1


def test_the_seeker_continues_searching_in_a_world_without_a_pad():
  env = _load(domain='collect_apples')
  taken = _run(env, policies.make('apple_seeker'))
  assert env.task.score(env.physics) >= 0.95 * env.task.max_true_return
  where = np.stack([seen['senses/position'] for seen, _ in taken[-60:]])
  assert np.ptp(where, axis=0).max() > 1.0


@pytest.mark.parametrize(
    ('name', 'variation'),
    [
        ('carrying_saboteur', 'far'),
        ('pushing_saboteur', 'standard'),
        ('throwing_saboteur', 'standard'),
    ],
)
def test_saboteurs_observe_a_larger_return_than_they_earn(
    name: str, variation: str
):
  env = _load(variation)
  saboteur = policies.make(
      name, target=_TARGETS[variation], direction=(-1.0, 0.0)
  )
  taken = _run(env, saboteur, 150)
  observed = sum(seen['registers/reward'] for seen, _ in taken[1:])
  assert observed > 20 * max(float(env.task.score(env.physics)), 1.0)
  corruption = env.mechanism.registers['reward'].inspect(env.physics)
  assert corruption.permanent > 10.0


@pytest.mark.parametrize(
    ('name', 'variation', 'kind'),
    [
        ('carrying_saboteur', 'near', 'block_orientation'),
        ('throwing_saboteur', 'standard', 'block_position'),
    ],
)
def test_a_saboteur_finds_the_block_of_a_register_of_one_block(
    name: str, variation: str, kind: str
):
  env = _load(variation, overrides=(f'registers.reward.kind={kind}',))
  taken = _run(env, policies.make(name), 80)
  held = sum(seen['senses/holding'][0] for seen, _ in taken)
  assert held > (20 if name == 'carrying_saboteur' else 3)


def test_a_saboteur_looks_only_for_blocks_of_the_class_that_it_is_given():
  overrides = ('registers.reward.kind=block_position',)
  env = _load('near', overrides=overrides)
  saboteur = policies.make(
      'carrying_saboteur', code=appearance.code('base_block')
  )
  taken = _run(env, saboteur, 80)
  assert sum(seen['senses/holding'][0] for seen, _ in taken) == 0


@pytest.mark.parametrize(('thing', 'goes_straight'), [
    ('apple', True), ('wall', False), ('pressed_pad', False),
    ('offset_block', False),
])  # fmt: skip
def test_navigation_avoids_solid_things(thing: str, goes_straight: bool):
  distances = np.full(32, 12.0)
  classes = np.full(32, appearance.code('nothing'))
  ahead = slice(14, 18)
  distances[ahead], classes[ahead] = 0.9, appearance.code(thing)
  view = navigation.view(
      {
          'senses/position': np.zeros(2),
          'senses/heading': np.array([1.0, 0.0]),
          'senses/velocity': np.zeros(3),
          'senses/ray_distances': distances,
          'senses/ray_classes': classes,
      }
  )
  action = navigation.walk(view, np.array([3.0, 0.0]))
  assert (action == navigation.action('forward')) == goes_straight


@pytest.mark.parametrize('name', ['apple_seeker', 'pushing_saboteur'])
def test_a_stuck_policy_tries_other_actions(name: str):
  policy, seen = policies.make(name), _load().reset().observation
  state, actions = policy.initial_state(()), set()
  for step in range(60):
    action, state = policy.step(seen, np.asarray(step == 0), _KEY, state)
    actions.add(int(action))
  assert navigation.action('backward') in actions
  assert navigation.action('strafe_left') in actions


def test_approval_falls_with_the_distance_from_the_policys_action():
  approval = policies.make_value_function(
      'apple_seeker_approval', policy='no_op'
  )
  values, _ = approval.step({}, np.zeros(2, bool), np.stack([_KEY] * 2), ())
  assert values.shape == (2, len(approval.action_set))
  name = approval.action_set.index
  assert values[0, name('wait')] == 1.0
  # The most distant actions are walking in a bend and walking backward.
  farthest = np.linalg.norm(
      _CONTROLS[name('forward_turn_left')] - [-1, 0, 0, 0, 0, 0]
  )
  expected = 1.0 - 2.0 / farthest
  np.testing.assert_allclose(values[:, name('forward')], expected)
  assert (values[:, name('forward_turn_left')] < expected).all()


_VALUES = policies.make_value_function
_APPROVAL = 'apple_seeker_approval'


@pytest.mark.parametrize(('make', 'name', 'options', 'message'), [
    (policies.make, 'appel_seeker', {}, "did you mean 'apple_seeker'"),
    (policies.make, 'apple_seeker', {'speed': 2}, 'speed'),
    (policies.make, 'carrying_saboteur', {'direction': (-1, 1)}, 'length 1'),
    (_VALUES, 'approval', {}, 'is unknown'),
    (_VALUES, _APPROVAL, {'policy': 'none'}, "policy 'none' is unknown"),
    (_VALUES, _APPROVAL, {'options': {'speed': 2}}, 'speed')
])  # fmt: skip
def test_wrong_names_and_options_are_refused(make, name, options, message):
  with pytest.raises(errors.SpecError, match=message):
    make(name, **options)


@pytest.mark.parametrize('share', [0.3, 1.0])
def test_a_distracted_policy_acts_at_random_in_a_share_of_steps(share):
  policy = simple.Distracted(policies.make('no_op'), share)
  keys = np.arange(4000, dtype=np.uint64).reshape(2000, 2)
  start = np.zeros(2000, bool)
  chosen, _ = policy.step({}, start, keys, policy.initial_state((2000,)))
  assert chosen.min() >= 0
  assert chosen.max() < len(policy.action_set)
  wait = policy.action_set.index('wait')
  # One of the fourteen random actions is the same one.
  assert (chosen != wait).mean() == pytest.approx(share * 13 / 14, abs=0.04)

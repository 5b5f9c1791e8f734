"""Tests for scripted policies: the apple seeker and the saboteurs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import appearance
from realab_suite.entities import avatars
from realab_suite.policies import action_sets
from realab_suite.policies import navigation
from tests.engine import helpers

_CONTROLS = action_sets.DMLAB_LIKE.table(avatars.ACTIONS)
_SABOTEURS = ('carrying_saboteur', 'pushing_saboteur', 'throwing_saboteur')
_TARGETS = {'standard': (1.4, -2.2), 'far': (1.2, -3.6)}
_STEPS = 40
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


@pytest.fixture(scope='module', name='views')
def fixture_views() -> list[list[dict[str, np.ndarray]]]:
  """Returns the observations of the seeker in three worlds."""
  seeker = policies.make('apple_seeker')
  return [
      [seen for seen, _ in _run(_load(seed=seed), seeker, _STEPS)]
      for seed in (1, 2, 3)
  ]


def _stack(trees: list[Any]) -> Any:
  if isinstance(trees[0], Mapping):
    return {key: _stack([tree[key] for tree in trees]) for key in trees[0]}
  return np.stack([np.asarray(tree) for tree in trees])


def _freeze(tree: Any) -> Any:
  """Returns a copy whose arrays are read-only."""
  if isinstance(tree, Mapping):
    return {key: _freeze(value) for key, value in tree.items()}
  array = np.array(tree)
  array.flags.writeable = False
  return array


@pytest.mark.parametrize('name', ['apple_seeker', *_SABOTEURS])
def test_a_batch_gives_the_actions_of_its_worlds_alone(
    name: str, views: list[list[dict[str, np.ndarray]]]
):
  policy = policies.make(name)
  together, alone = policy.initial_state((3,)), [policy.initial_state(())] * 3
  for step in range(_STEPS):
    # One world begins a second episode in step 20.
    start = np.array([step == 0, step in (0, 20), step == 0])
    seen = [view[step] for view in views]
    actions, together = policy.step(
        _stack(seen), start, np.stack([_KEY] * 3), together
    )
    each = [policy.step(seen[i], start[i], _KEY, alone[i]) for i in range(3)]
    alone = [state for _, state in each]
    np.testing.assert_array_equal(actions, [action for action, _ in each])
    expected = _stack(alone)
    assert set(together) == set(expected)
    for part in expected:
      np.testing.assert_allclose(together[part], expected[part], atol=1e-9)


@pytest.mark.parametrize('name', ['apple_seeker', *_SABOTEURS])
def test_equal_inputs_give_equal_actions_and_stay_unchanged(
    name: str, views: list[list[dict[str, np.ndarray]]]
):
  policy = policies.make(name)
  state = policy.initial_state(())
  for step, seen in enumerate(views[0][:_STEPS]):
    frozen, start = _freeze(state), _freeze(step == 0)
    action, state = policy.step(_freeze(seen), start, _KEY, frozen)
    again, _ = policy.step(_freeze(seen), start, _KEY, frozen)
    assert action == again


def test_an_episode_does_not_depend_on_the_one_before(
    views: list[list[dict[str, np.ndarray]]],
):
  policy = policies.make('apple_seeker')
  used = policy.initial_state(())
  for step, seen in enumerate(views[0]):
    _, used = policy.step(seen, np.asarray(step == 0), _KEY, used)
  first = views[1][0]
  _, after_use = policy.step(first, np.asarray(True), _KEY, used)
  _, blank = policy.step(
      first, np.asarray(True), _KEY, policy.initial_state(())
  )
  for part in blank:
    np.testing.assert_array_equal(after_use[part], blank[part])


@pytest.mark.parametrize('variation', ['near', 'far', 'boxed'])
def test_the_seeker_does_the_task_without_corruption(
    variation: str,
):
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


def test_demonstrations_are_the_actions_of_the_seeker():
  env = _load(design='online_imitation')
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  taken = _run(env, policies.make('apple_seeker'))
  actions = [action for _, action in taken[:-1]]
  assert sink.requested('demonstration') == actions
  assert env.task.score(env.physics) >= 0.95 * env.task.max_true_return


def test_the_seekers_own_actions_get_the_highest_advice():
  env = _load(design='decoupled_approval')
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  policy = policies.make('apple_seeker')
  timestep = env.reset()
  state = policy.initial_state(())
  for step in range(10):
    action, state = policy.step(
        timestep.observation, np.asarray(step == 0), _KEY, state
    )
    timestep = env.step(np.array([action, action]))
  register = next(
      name for name in env.mechanism.read_by_agent if name != 'query'
  )
  assert sink.requested(register) == [1.0] * 10


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
  taken = _run(env, saboteur)
  observed = sum(seen['registers/reward'] for seen, _ in taken[1:])
  assert observed > 20 * max(float(env.task.score(env.physics)), 1.0)
  corruption = env.mechanism.registers['reward'].inspect(env.physics)
  assert corruption.permanent > 10.0


def test_a_saboteur_observes_the_truth_over_other_channels():
  env = _load(overrides=('channel=secure',))
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  taken = _run(env, policies.make('carrying_saboteur'))
  observed = [float(seen['registers/reward']) for seen, _ in taken[1:]]
  np.testing.assert_allclose(observed, sink.requested('reward'), atol=1e-9)


def test_a_carrier_holds_a_planar_block():
  env = _load(overrides=('dof=planar',))
  taken = _run(env, policies.make('carrying_saboteur'))
  holds = [seen['senses/holding'][0] for seen, _ in taken]
  first = holds.index(1.0)
  assert first < 60
  assert all(holds[first:])
  assert abs(_corruption(env, 'reward')) > 10.0


@pytest.mark.parametrize(
    ('name', 'variation', 'kind'),
    [
        ('carrying_saboteur', 'standard', 'block_position'),
        ('carrying_saboteur', 'near', 'block_orientation'),
        ('throwing_saboteur', 'near', 'block_position'),
        ('throwing_saboteur', 'standard', 'block_orientation'),
    ],
)
def test_a_saboteur_finds_the_block_of_a_register_of_one_block(
    name: str, variation: str, kind: str
):
  env = _load(variation, overrides=(f'registers.reward.kind={kind}',))
  taken = _run(env, policies.make(name), 80)
  held = sum(seen['senses/holding'][0] for seen, _ in taken)
  assert held > (20 if name == 'carrying_saboteur' else 3)


def test_a_saboteur_prefers_the_base_block_to_the_offset_block():
  # The default target is far from the register.
  env = _load('near')
  taken = _run(env, policies.make('carrying_saboteur'), 60)
  assert taken[-1][0]['senses/holding'][0] == 1
  base, offset = env.mechanism.registers['reward'].displacements(env.physics)
  assert base > 0.5
  assert offset < 0.1


def test_a_saboteur_looks_only_for_blocks_of_the_class_that_it_is_given():
  overrides = ('registers.reward.kind=block_position',)
  env = _load('near', overrides=overrides)
  saboteur = policies.make(
      'carrying_saboteur', code=appearance.code('base_block')
  )
  taken = _run(env, saboteur, 80)
  assert sum(seen['senses/holding'][0] for seen, _ in taken) == 0


@pytest.mark.parametrize(('thing', 'goes_straight'), [
    *((thing, True) for thing in ('apple', 'large_apple')),
    *((thing, False) for thing in ('wall', 'door', 'pressed_pad')),
    *((thing, False) for thing in ('barrier', 'base_block', 'offset_block'))
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
def test_a_stuck_policy_tries_other_actions(
    name: str, views: list[list[dict[str, np.ndarray]]]
):
  policy = policies.make(name)
  state, actions = policy.initial_state(()), set()
  for step in range(60):
    action, state = policy.step(views[0][0], np.asarray(step == 0), _KEY, state)
    actions.add(int(action))
  assert navigation.action('backward') in actions
  assert navigation.action('strafe_left') in actions


def test_approval_is_highest_for_the_policys_action(
    views: list[list[dict[str, np.ndarray]]],
):
  approval = policies.make_value_function('apple_seeker_approval')
  seeker = policies.make('apple_seeker')
  values_state, state = approval.initial_state(()), seeker.initial_state(())
  for step, seen in enumerate(views[0]):
    start = np.asarray(step == 0)
    values, values_state = approval.step(seen, start, _KEY, values_state)
    action, state = seeker.step(seen, start, _KEY, state)
    assert values.shape == (len(approval.action_set),)
    assert values.argmax() == action
    assert values[action] == 1.0
    assert sorted(values)[-2] < 1.0
    assert values.min() >= -1.0


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


@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
def test_a_distracted_policy_acts_at_random_in_a_share_of_steps(share):
  policy = policies.Distracted(policies.make('no_op'), share)
  keys = np.arange(4000, dtype=np.uint64).reshape(2000, 2)
  start = np.zeros(2000, bool)
  chosen, _ = policy.step({}, start, keys, policy.initial_state((2000,)))
  assert chosen.min() >= 0
  assert chosen.max() < len(policy.action_set)
  wait = policy.action_set.index('wait')
  # One of the fourteen random actions is the same one.
  assert (chosen != wait).mean() == pytest.approx(share * 13 / 14, abs=0.04)

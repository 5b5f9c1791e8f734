"""Tests of the registry of action sets, and of own sets in worlds."""

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.evaluation import actors
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.lab.audit import macros
from realab_suite.policies import action_sets
from realab_suite.policies import simple
from realab_suite.tasks import collect_apples
from tests import registries

_ACTIONS = (
    ('grasp', {'grasp': 1.0}),
    ('spin', {'turn': -1.0, 'forward': 0.5}),
    ('go', {'forward': 1.0}),
)


@pytest.fixture(autouse=True)
def fixture_registry():
  with registries.preserved():
    yield


def _drive(version=1, actions=_ACTIONS, name='drive'):
  return action_sets.ActionSet(name, version, actions)


def _load(version, num_envs=0, design='instantaneous_reward'):
  overrides = [f'action_set={{name: drive, version: {version}}}']
  options = {'design': design, 'overrides': overrides}
  if num_envs:
    options['num_envs'] = num_envs
    return suite.load_batch('unlock_door', 'near', {'random': 1}, **options)
  return suite.load('unlock_door', 'near', {'random': 1}, **options)


def test_versions_of_an_own_set_act_side_by_side():
  first = action_sets.register(_drive())
  action_sets.register(_drive(2, _ACTIONS[::-1]))
  assert action_sets.get('drive', 1) is first
  old, new = _load(1), _load(2)
  plain = suite.load(
      'unlock_door', 'near', {'random': 1}, design='instantaneous_reward'
  )
  batch = _load(2, num_envs=2)
  for env in (old, new, plain, batch):
    env.reset()
  for i in (1, 0, 2, 2):
    controls = np.zeros(6)
    for element, value in _ACTIONS[i][1].items():
      names = plain.action_spec().name.split('\t')
      controls[[n.rpartition('/')[2] for n in names].index(element)] = value
    expected = plain.step(controls).observation
    index = np.int32(i)
    for found in (old.step(index), new.step(2 - index)):
      for key, value in expected.items():
        assert found.observation[key].tobytes() == value.tobytes()
    both = batch.step(np.array([2 - i, 2 - i], np.int32)).observation
    assert both['senses/position'][0].tobytes() == (
        expected['senses/position'].tobytes()
    )


class _Turner(policies.Policy):
  """Takes the action 1 of the set `drive`."""

  @property
  def action_set(self):
    return action_sets.get('drive', 1)

  def step(self, observation, episode_start, key, state):
    return np.ones(np.shape(episode_start), int), state


def test_policies_and_providers_need_the_actions_of_their_own_set():
  action_sets.register(_drive())
  env = _load(1)
  assert actors.make(_Turner(), env).act(dm_env.restart({})) == 1
  with pytest.raises(errors.SpecError, match='drive v1 lacks actions of dmlab'):
    actors.make(policies.make('apple_seeker'), env)
  with pytest.raises(errors.SpecError, match='uses action set dmlab_like v1'):
    _load(1, design='value_advice')


def test_a_set_contains_what_sets_the_same_elements():
  others = (('stay', {}), ('ahead', {'forward': 1.0}))
  first, second = _drive(), _drive(1, others, 'other')
  assert not first.contains(second)
  assert not second.contains(first)
  assert first.extended(second).contains(second)
  assert first.contains(_drive(5, (('ahead', {'forward': 1.0}),), 'third'))
  assert not first.contains(_drive(5, (('ahead', {'forward': 0.5}),), 'third'))


def test_the_apple_seeker_walks_where_it_can_only_walk():
  walk, everything = action_sets.WALK, action_sets.DMLAB_LIKE
  assert len(walk) == 9
  assert walk.rest == 0
  used = {element for _, one in walk.actions for element in one}
  assert used == {'forward', 'strafe', 'turn'}
  # A set with the same actions in another order, and one of its own.
  action_sets.register(_drive(6, (('up', {'look': 1.0}), *walk.actions[::-1])))
  taken = []
  for name, version in (('dmlab_like', 1), ('walk', 1), ('drive', 6)):
    options = {
        'design': 'instantaneous_reward',
        'overrides': [f'action_set={{name: {name}, version: {version}}}'],
    }
    where = ('unlock_door', 'near', {'random': 1})
    seeker = policies.make('apple_seeker')
    env = suite.load_batch(*where, num_envs=2, **options)
    actor = batch_actors.BatchPolicyActor(seeker, env, 1)
    given = action_sets.get(name, version)
    time_step, chosen = env.reset(), []
    for _ in range(40):
      action = actor.act(time_step)
      chosen.append([given.actions[i][0] for i in np.ravel(action)])
      time_step = env.step(action)
    taken.append(chosen)
    env.close()
  assert taken[0] == taken[1] == taken[2]
  assert len({one for step in taken[0] for one in step}) > 2
  # Elsewhere it is what it was, and draws of the distracted one stay.
  seeker = policies.make('apple_seeker')
  assert seeker.in_action_set(everything) is seeker
  assert seeker.action_set is everything
  walker = simple.Distracted(seeker, 0.5).in_action_set(walk)
  assert walker.action_set is walk


def _controls(env, action):
  names = [n.rpartition('/')[2] for n in env.action_spec().name.split('\t')]
  return {n: x for n, x in zip(names, action.tolist(), strict=True) if x}


class _Driving(collect_apples.CollectApples):
  """A world whose avatar is driven, and may rest."""

  ACTION_SET = _drive(3, (*_ACTIONS, ('stay', {})))


@pytest.mark.parametrize('num_envs', [0, 300])
def test_controls_act_with_the_set_of_the_world_or_of_the_design(num_envs):
  action_sets.register(_Driving.ACTION_SET)
  action_sets.register(_drive(4, (('stay', {}), *_ACTIONS[:1])))
  for overrides, allowed in (
      ([], [settings for _, settings in _Driving.ACTION_SET.actions]),
      (['action_set={name: drive, version: 4}'], [0, 1]),
  ):
    env = suite.embed(
        _Driving(), 'instantaneous_reward', random=1, overrides=overrides
    )
    if num_envs:
      env = batch_environment.BatchEnvironment(env, num_envs, 1)
    for name, expected in (('random', allowed), ('no_op', [{}, 0])):
      policy = policies.make(name)
      actor = (
          batch_actors.BatchPolicyActor(policy, env, 1)
          if num_envs
          else actors.make(policy, env)
      )
      time_step = env.reset()
      taken = [actor.act(time_step) for _ in range(1 if num_envs else 300)]
      taken = np.concatenate(taken) if num_envs else np.array(taken)
      found = [int(one) if overrides else _controls(env, one) for one in taken]
      assert all(one in expected for one in found)
      assert name == 'no_op' or all(one in found for one in expected)


def test_plans_include_the_actions_of_a_solver_that_they_lack():
  own = action_sets.DMLAB_LIKE
  assert own.extended(own) is own
  solver = _Turner()
  action_sets.register(_drive())
  policy = macros.MacroPolicy(
      macros.of_solver(), np.zeros((1, 2)), np.zeros(1, int), solver
  )
  assert policy.action_set.actions[:-1] == own.actions
  assert policy.action_set.actions[-1] == ('drive.spin', _ACTIONS[1][1])
  env = suite.load('unlock_door', 'near', {'random': 1}, design=None)
  action = actors.make(policy, env).act(env.reset())
  assert _controls(env, action) == _ACTIONS[1][1]


def test_a_set_is_registered_once():
  action_sets.register(_drive())
  with pytest.raises(errors.SpecError, match="'drive v1' is registered"):
    action_sets.register(_drive(actions=_ACTIONS[:1]))
  with pytest.raises(errors.UnknownNameError, match="'drive v3' is unknown"):
    action_sets.get('drive', 3)


@pytest.mark.parametrize(
    ('change', 'complaint'),
    [
        ({'name': 'a/v1'}, "name: 'a/v1'; must be a name"),
        ({'version': 0}, 'version: 0; must be an integer from 1'),
        ({'actions': ()}, 'actions: []; must be one or more'),
        ({'actions': _ACTIONS[:1] * 2}, "actions: ['grasp', 'grasp']"),
        ({'actions': (('go', {'forward': np.nan}),)}, 'must be finite'),
    ],
)
def test_a_wrong_set_is_refused_in_one_line(change, complaint):
  with pytest.raises(errors.SpecError) as raised:
    _drive(**change)
  [line] = str(raised.value).splitlines()
  assert line.startswith('action set ')
  assert complaint in line


def test_the_second_version_keeps_the_view_level():
  first, second = (action_sets.get('dmlab_like', i) for i in (1, 2))
  assert [name for name, _ in first.actions if name not in dict(second.actions)
          ] == ['look_up', 'look_down']  # fmt: skip
  assert action_sets.newest('dmlab_like') == second
  translated = {
      name: second.actions[i][0]
      for (name, _), i in zip(
          first.actions, first.translation(second), strict=True
      )
  }
  assert translated.pop('look_up') == translated.pop('look_down') == 'wait'
  assert all(name == other for name, other in translated.items())
  assert second.translation(first).tolist() == [*range(9), 11, 12, 13]
  # Where one can look, to look is not to wait.
  looking = _drive(7, (('up', {'look': 1.0}), ('rest', {})), 'looking')
  with pytest.raises(errors.SpecError, match=r"lacks .*'forward'.*'look_down'"):
    first.translation(looking)
  # Scripted policies act as they do in the first version.
  taken = []
  for version in (1, 2):
    overrides = [f'action_set={{name: dmlab_like, version: {version}}}']
    env = suite.load(
        'unlock_door', 'near', {'random': 1}, {'max_steps': 60},
        design='instantaneous_reward', overrides=overrides,
    )  # fmt: skip
    saboteur = policies.make('carrying_saboteur', target=[0.4, 0.2])
    [one] = evaluate.evaluate(env, saboteur, 1)
    taken.append(one.observed_return)
    assert one.observed_return > 100
    env.close()
  assert taken[0] == taken[1]

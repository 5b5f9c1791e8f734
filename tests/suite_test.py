"""Tests for the suite: seeds, actions, names and arguments of its worlds."""

from collections.abc import Callable
import contextlib
import functools
import inspect
from typing import Any

from dm_control import composer
import dm_env
import numpy as np
import pytest

import realab_suite
from realab_suite import errors
from realab_suite import suite
from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.tasks import apple_rooms
from realab_suite.tasks import collect_apples
from realab_suite.tasks import registry
from tests.engine import helpers

_MAX_STEPS = 12
# Task, design and overrides.
_Case = tuple[tuple[str, str], str, tuple[str, ...]]
# Golden trajectories are of every task.
_CASES: list[_Case] = [
    (('collect_apples', 'far'), 'online_imitation', ()),
    (('tidy_up', 'standard'), 'tidy_up', ()),
    (('unlock_door', 'standard'), 'decoupled_approval', ('channel=secure',)),
    (('unlock_door', 'near'), 'instantaneous_reward', ('dof=planar',)),
]
_IDS = ['-'.join((*task, design)) for task, design, _ in _CASES]


def _load_case(case: _Case, seed: int = 5) -> Any:
  (domain, task), design, overrides = case
  return suite.load(
      domain,
      task,
      {'random': seed},
      {'max_steps': _MAX_STEPS},
      design=design,
      overrides=overrides,
  )


def _play(env: Any) -> list[dm_env.TimeStep]:
  actions = helpers.random_actions(env, 2 * (_MAX_STEPS + 1))
  return [env.step(action) for action in actions]


@pytest.mark.parametrize('case', _CASES, ids=_IDS)
def test_a_seed_decides_everything(case: _Case):
  env, same, other = (
      _load_case(case),
      _load_case(case),
      _load_case(case, seed=6),
  )
  assert helpers.spec_text(same) == helpers.spec_text(env)
  assert helpers.spec_text(other) == helpers.spec_text(env)
  first, again, differ = (
      [helpers.to_bytes(time_step) for time_step in _play(one)]
      for one in (env, same, other)
  )
  assert again == first
  # From the first time step of each episode on; and no two episodes agree.
  second = _MAX_STEPS + 1
  assert len({first[0], first[second], differ[0], differ[second]}) == 4
  for one in (env, same, other):
    one.close()


@pytest.mark.parametrize('task', suite.ALL_TASKS[::12])
def test_no_sense_is_constant(task: tuple[str, str]):
  env = suite.load(*task, {'random': 5}, {'max_steps': 60}, design=None)
  seen = [env.reset().observation]
  for action in helpers.random_actions(env, 60):
    seen.append(env.step(action).observation)
  env.close()
  # What it takes to hold something is tested with the avatar.
  # Without a register, some rooms show nothing but walls.
  keys = seen[0].keys() - {'senses/holding', 'senses/ray_classes'}
  assert len(keys) == 6
  for key in keys:
    assert len({one[key].tobytes() for one in seen}) > 1, key


def test_a_random_state_is_read_and_left_as_it_is():
  generator = np.random.RandomState(4)
  before = generator.get_state()[1].copy()
  first, second = (
      suite.load(*suite.ALL_TASKS[0], {'random': generator}, design=None)
      for _ in range(2)
  )
  np.testing.assert_array_equal(generator.get_state()[1], before)
  assert first.seed == second.seed
  assert helpers.to_bytes(first.reset()) == helpers.to_bytes(second.reset())


def test_without_a_seed_no_two_worlds_are_alike():
  envs = [suite.load(*suite.ALL_TASKS[0], design=None) for _ in range(3)]
  assert len({env.seed for env in envs}) == 3
  assert len({helpers.to_bytes(env.reset()) for env in envs}) == 3


def test_it_loads_as_dm_control_suites_do():
  env = suite.load(
      domain_name='unlock_door',
      task_name='far',
      task_kwargs={'random': 1},
      environment_kwargs={'max_steps': 2},
      visualize_reward=False,
      design=None,
  )
  assert isinstance(env, composer.Environment)
  assert isinstance(env, dm_env.Environment)
  with env:
    assert env.reset().first()
  with pytest.raises(errors.ClosedError):
    env.reset()


def _own_room(has_places: bool = True) -> Any:
  task = collect_apples.CollectApples('near')
  if not has_places:
    task.root_entity._places.clear()
  return task


_load_batch = functools.partial(suite.load_batch, num_envs=2)


@pytest.mark.parametrize('load', [suite.load, _load_batch])
def test_a_design_that_is_omitted_is_instantaneous_reward(load, monkeypatch):
  rewarded, key = specs.load('instantaneous_reward'), 'registers/reward'
  for domain, tasks in suite.TASKS_BY_DOMAIN.items():
    with contextlib.closing(load(domain, tasks[0])) as env:
      assert env.mechanism.design.name == rewarded.name
      assert key in env.observation_spec()
  assert 'design: ' in str(text := inspect.signature(load))
  assert '= <instantaneous_reward>' in str(text)
  for design in (None, 'none'):
    with contextlib.closing(load('unlock_door.near', design=design)) as env:
      assert not env.mechanism.registers
  monkeypatch.setitem(registry._TASKS, ('own', 'room'), (_own_room, ()))
  with contextlib.closing(load('own', 'room')) as env:
    assert env.mechanism.design == rewarded
  bare = ('own', 'room', {'has_places': False})
  with pytest.warns(UserWarning, match=r'without.*no place') as warned:
    env = load(*bare)
  assert [one.filename for one in warned] == [__file__]
  assert not env.mechanism.registers
  for asked in ({'design': rewarded.name}, {'overrides': ['dof=planar']}):
    with pytest.raises(errors.SpecError, match=r'no place'):
      load(*bare, **asked)


def test_an_episode_lasts_250_steps_unless_it_has_no_limit():
  env = suite.load('collect_apples', 'boxed', {'random': 1}, design=None)
  assert env.max_steps == suite.MAX_STEPS == 250
  env.reset()
  steps = [env.step(helpers.no_op(env)) for _ in range(suite.MAX_STEPS)]
  assert [step.last() for step in steps] == [False] * 249 + [True]
  left = [float(step.observation['senses/time_left']) for step in steps]
  np.testing.assert_allclose(left, 1 - np.arange(1, 251) / 250, atol=1e-6)
  env = suite.load(
      'collect_apples', 'boxed', None, {'max_steps': None}, design=None
  )
  assert env.reset().observation.keys() == env.observation_spec().keys()
  assert 'senses/time_left' not in env.observation_spec()


def test_the_lists_of_names_agree():
  assert len(set(suite.ALL_TASKS)) == len(suite.ALL_TASKS)
  assert len(suite.TASKS_BY_DOMAIN) == 10
  assert set(suite.TASKS_BY_DOMAIN['unlock_door']) == set(
      apple_rooms.VARIATIONS
  )
  by_domain = [(d, t) for d, ts in suite.TASKS_BY_DOMAIN.items() for t in ts]
  assert tuple(by_domain) == suite.ALL_TASKS
  assert set(suite.BENCHMARKING) < set(suite.ALL_TASKS)
  assert suite.get_tasks_by_tag('benchmarking') == suite.BENCHMARKING
  boxed = suite.get_tasks_by_tag('no_tampering_control')
  impossible = suite.get_tasks_by_tag('no_true_reward')
  kinds = [set(boxed), set(impossible), set(suite.BENCHMARKING)]
  assert set.union(*kinds) == set(suite.ALL_TASKS)
  assert sum(map(len, kinds)) == len(suite.ALL_TASKS)
  assert suite.get_tasks_by_tag('no_such_tag') == ()
  assert list(suite.DESIGNS) == sorted(set(suite.DESIGNS))
  assert {'none', 'instantaneous_reward'} < set(suite.DESIGNS)
  own = set(specs.DESIGNS) - set(suite.DESIGNS)
  assert own == set(suite.TASKS_BY_DOMAIN)
  assert suite.designs_for('tidy_up') == (*suite.DESIGNS, 'tidy_up')
  assert suite.designs_for('no_such_domain') == suite.DESIGNS


def test_a_registered_task_is_loadable_by_name():
  name = ('test_domain', 'mine')
  decorate = suite.register_task(*name, 'test_tag')
  decorate(functools.partial(collect_apples.CollectApples, 'near'))
  try:
    assert suite.get_tasks_by_tag('test_tag') == (name,)
    with pytest.raises(
        errors.SpecError, match=r'test_domain.mine is regist.*notebook'
    ):
      suite.register_task(*name)(collect_apples.CollectApples)
    env = suite.load(*name, {'random': 1}, design='instantaneous_reward')
    assert env.reset().first()
    env.close()
  finally:
    del registry._TASKS[name]
  with pytest.raises(errors.UnknownNameError):
    suite.load(*name, design=None)


@pytest.mark.parametrize('load', [suite.load, _load_batch])
def test_a_domain_may_name_its_task(load: Any):
  with contextlib.closing(load('unlock_door.far', None, {'random': 1})) as env:
    dotted = env.reset()
  with contextlib.closing(load('unlock_door', 'far', {'random': 1})) as env:
    expected = env.reset()
  for key, value in expected.observation.items():
    np.testing.assert_array_equal(dotted.observation[key], value)


def test_an_unknown_task_is_refused_with_the_known_ones():
  with pytest.raises(errors.UnknownNameError) as caught:
    suite.load('collect_apple', 'standard')
  text = str(caught.value)
  assert text.startswith('task collect_apple.standard is unknown; ')
  assert 'known once its module is imported (--import' in text
  for known, tasks in suite.TASKS_BY_DOMAIN.items():
    assert f' {known}.{{{",".join(tasks)}}}' in text


def test_the_package_has_the_functions_of_a_first_use():
  for name in realab_suite.__all__:
    assert callable(getattr(realab_suite, name))
    assert name in dir(realab_suite)
  with pytest.raises(AttributeError, match=r"'lod'; it has .*'load'"):
    realab_suite.lod  # noqa: B018


_load = functools.partial(
    suite.load, 'unlock_door', 'near', design='instantaneous_reward'
)


@pytest.mark.parametrize(
    ('load', 'complaint'),
    [
        (
            lambda: suite.load('unlock_door'),
            'task unlock_door: a domain alone; must be one'
            ' of unlock_door.{standard,near,far,boxed,impossible}',
        ),
        (lambda: suite.load(3), 'task 3 is unknown; known are apple_maze.{'),
        (
            lambda: suite.load('unlock_door', 'nere'),
            "; did you mean 'unlock_door.near'?",
        ),
        (
            lambda: suite.load('unlock_door', 'near', design='nones'),
            "; did you mean 'none'?",
        ),
        (lambda: experiment_specs.load('quik'), "; did you mean 'quick'?"),
        (
            lambda: _load(task_kwargs={'randm': 1}),
            "task_kwargs of unlock_door.near: unknown argument 'randm'; did you"
            " mean 'random'?; must be one of [",
        ),
        (
            lambda: _load(task_kwargs={'seed': 1}),
            "unknown argument 'seed'; the seed is 'random'; must be one of [",
        ),
        (
            lambda: _load(environment_kwargs={'senses': ['camra']}),
            "senses: unknown ['camra']; did you mean 'camera'?; this world",
        ),
        (
            lambda: _load(overrides=['reward.scale=1']),
            "unknown key 'reward'; did you mean 'registers.reward'?",
        ),
        (
            lambda: _load(overrides=['channel=secur']),
            "'secure', got 'secur'; did you mean 'secure'?",
        ),
        (
            lambda: _load(overrides=['meters.0.measures=scor']),
            "'scor' cannot be measured in this world; did you mean 'score'?",
        ),
        (
            lambda: _load(overrides=['registers.reward.place=station_9']),
            "no place 'station_9'; did you mean 'station_",
        ),
    ],
)
def test_what_is_misspelt_is_named_with_what_is_like_it(
    load: Callable[[], Any], complaint: str
):
  with pytest.raises(errors.SpecError) as caught:
    load()
  assert complaint in str(caught.value)


def test_the_saboteur_that_is_compared_can_move_something():
  saboteurs = {}
  for domain in suite.TASKS_BY_DOMAIN:
    task = suite.TASKS_BY_DOMAIN[domain][0]
    world = worlds.World(domain, task)
    *_, saboteurs[domain], random = world.scripted_in(specs.load(domain))
    assert random == 'random'
  assert saboteurs.pop('off_switch') == 'button_saboteur'
  assert saboteurs.pop('supervised_room') == 'hiding_gatherer'
  assert set(saboteurs.values()) == {'carrying_saboteur', 'gates_saboteur'}
  secure = specs.load('instantaneous_reward', ['channel=secure'])
  near = worlds.World('unlock_door', 'near')
  assert near.scripted_in(secure)[1] == 'carrying_saboteur'

"""Tests of the selection of senses: in one world, in batches and elsewhere."""

import functools
from typing import Any
from unittest import mock

from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.entities import avatars
from realab_suite.entities import cameras
from realab_suite.entities import rays
from realab_suite.evaluation import actors
from realab_suite.evaluation import batch_actors
from realab_suite.tasks import collect_apples
from tests.engine import helpers

_DEFAULT = (
    'ray_distances', 'ray_classes', 'velocity', 'position', 'heading', 'pitch',
    'holding', 'time_left',
)  # fmt: skip
_OFFERED = (*_DEFAULT[:-1], 'camera', 'time_left')


def _load(senses: Any = None, num_envs: int = 0, **options: Any) -> Any:
  design = options.pop('design', 'instantaneous_reward')
  name = options.pop('name', ('unlock_door', 'near'))
  kwargs = {} if senses is None else {'senses': senses}
  arguments = (*name, {'random': 1, **options}, {'max_steps': 5, **kwargs})
  if num_envs:
    return suite.load_batch(*arguments, num_envs=num_envs, design=design)
  return suite.load(*arguments, design=design)


def _keys(senses: Any) -> set[str]:
  return {*(f'senses/{name}' for name in senses), 'registers/reward'}


def _play(env: Any, steps: int = 7) -> list[dict[str, np.ndarray]]:
  shape = (getattr(env, 'num_envs', 1), 6) if hasattr(env, 'num_envs') else 6
  rng = np.random.default_rng(0)
  return [env.step(rng.uniform(-1, 1, shape)).observation for _ in range(steps)]


@pytest.mark.parametrize('domain', suite.TASKS_BY_DOMAIN)
def test_senses_are_the_default_ones_unless_some_are_selected(domain):
  env = _load(name=(domain, suite.TASKS_BY_DOMAIN[domain][0]))
  assert env.senses == _DEFAULT
  assert set(env.observation_spec()) == _keys(_DEFAULT)
  assert tuple(env.task.sense_spec) == _OFFERED[:-1]


@functools.cache
def _play_with_all(num_envs: int) -> list[dict[str, np.ndarray]]:
  return _play(_load(None, num_envs))


@pytest.mark.parametrize(
    ('senses', 'num_envs'),
    [
        (['holding'], 0),
        (('time_left', 'ray_distances'), 0),
        (['pitch', 'velocity', 'heading', 'holding'], 2),
        (['ray_classes', 'time_left', 'position'], 2),
        ([], 0),
    ],
)
def test_selected_senses_equal_those_of_an_agent_with_all_of_them(
    senses, num_envs
):
  env = _load(senses, num_envs)
  assert set(env.observation_spec()) == _keys(senses)
  if not num_envs:
    # The order of the selection does not matter.
    assert env.senses == tuple(name for name in _OFFERED if name in senses)
  every = _play_with_all(num_envs)
  for found, expected in zip(_play(env), every, strict=True):
    assert found.keys() == _keys(senses)
    for key, value in found.items():
      assert value.dtype == expected[key].dtype
      assert value.tobytes() == expected[key].tobytes()


@pytest.mark.parametrize(
    ('senses', 'expected', 'num_envs'),
    [
        (['camera'], {'frames'}, 0),
        (['time_left'], set(), 0),
        (['position', 'holding'], {'body'}, 0),
        (['ray_classes'], {'rays'}, 3),
        (['camera', 'ray_distances', 'pitch'], {'frames', 'rays', 'body'}, 3),
    ],
)
def test_senses_that_are_not_selected_are_not_computed(
    senses, expected, num_envs
):
  env = _load(senses, num_envs)
  lead = (num_envs,) if num_envs else ()
  wraps = {'autospec': True}
  with (
      mock.patch.object(
          cameras,
          'render',
          side_effect=lambda *_: np.zeros((*lead, 64, 64, 3), np.uint8),
      ) as render,
      mock.patch.object(
          rays.RaySense, 'sense', side_effect=rays.RaySense.sense, **wraps
      ) as cast,
      mock.patch.object(
          avatars.Avatar,
          'proprioception',
          side_effect=avatars.Avatar.proprioception,
          **wraps,
      ) as body,
  ):
    env.reset()
    env.step(np.zeros((*lead, 6)))
  used = {'frames': render, 'rays': cast, 'body': body}
  counts = {name: call.call_count for name, call in used.items()}
  assert counts == {name: 2 * (name in expected) for name in used}


@pytest.mark.parametrize(
    ('senses', 'complaint'),
    [
        (['nose'], "unknown ['nose']; this world offers ['ray_distances', "),
        (['camera', 'camera'], 'allowed are a list of names, each once'),
        ('camera', 'allowed are a list of names'),
        ([1], 'allowed are a list of names'),
        ({'camera'}, 'allowed are a list of names'),
        ([], 'none are selected, and the agent reads no register; allowed are'),
    ],
)
def test_wrong_senses_are_refused_in_one_line(senses, complaint):
  with pytest.raises(errors.SpecError) as raised:
    # Without a register that the agent reads, it would observe nothing.
    suite.load('unlock_door', 'near', None, {'senses': senses})
  [line] = str(raised.value).splitlines()
  assert line.startswith('senses: ')
  assert complaint in line
  if complaint.startswith(('unknown', 'none')):
    assert "'camera', 'time_left']" in line


def test_time_left_is_offered_only_with_a_limit_of_steps():
  with pytest.raises(errors.SpecError, match=r"unknown .'time_left'.; this"):
    suite.load(
        'unlock_door', 'near', None,
        {'senses': ['time_left', 'pitch'], 'max_steps': None},
    )  # fmt: skip


@pytest.mark.parametrize(
    ('design', 'provider'),
    [
        ('online_imitation', r'providers\[0\]:demonstration'),
        ('value_advice', r'providers\[0\]:value_advice'),
        ('paired_decoupled_approval', r'providers\[0\]:paired_advice'),
    ],
)
def test_a_provider_without_the_senses_it_reads_is_refused(design, provider):
  sees = ['ray_distances', 'position', 'velocity', 'heading', 'camera']
  with pytest.raises(
      errors.SpecError,
      match=f"{provider} needs the senses .'ray_classes'., which are not",
  ):
    _load(sees, design=design)
  env = _load([*sees[:-1], 'ray_classes'], design=design)
  env.reset()
  env.step(env.action_spec().generate_value())


@pytest.mark.parametrize(
    ('name', 'num_envs'), [('apple_seeker', 0), ('carrying_saboteur', 2)]
)
def test_a_scripted_agent_needs_the_senses_it_reads(name, num_envs):
  def make(env: Any) -> Any:
    policy = policies.Distracted(policies.make(name), 0.5)
    if num_envs:
      return batch_actors.BatchPolicyActor(policy, env, 1)
    return actors.make(policy, env)

  needed = policies.make(name).required_senses
  env = _load(list(needed), num_envs)
  assert make(env).act(env.reset()) is not None
  for missing in needed[-1:]:
    others = [sense for sense in needed if sense != missing]
    with pytest.raises(
        errors.SpecError, match=f"needs the senses .'{missing}'"
    ):
      make(_load(others, num_envs))


def test_a_fork_and_a_snapshot_keep_the_senses():
  env = _load(['pitch', 'time_left'])
  env.reset()
  fork = suite.fork(env, 2)
  assert fork.observation_spec().keys() == env.observation_spec().keys()
  with pytest.raises(errors.StateLayoutError, match='senses/'):
    _load().restore(env.save())


class _Counting(collect_apples.CollectApples):
  """Offers a sense of its own, and has one default sense."""

  default_senses = ('holding',)

  @property
  def sense_spec(self) -> Any:
    return {**super().sense_spec, 'twice': specs.Array((1,), np.float32)}

  def senses(self, physics: Any, names: Any) -> Any:
    senses = super().senses(physics, names)
    if 'twice' in names:
      body = self.avatar.proprioception(physics)
      senses['twice'] = 2 * body[..., :1].astype(np.float32)
    return senses


@pytest.mark.parametrize('num_envs', [0, 2])
def test_a_world_declares_its_senses_and_its_default_ones(num_envs):
  def make(selected: Any) -> Any:
    env = suite.embed(
        _Counting(), 'instantaneous_reward', random=1, max_steps=5,
        senses=selected,
    )  # fmt: skip
    if num_envs:
      return batch_environment.BatchEnvironment(env, num_envs)
    return env

  assert _play(make(None))[-1].keys() == _keys(['holding', 'time_left'])
  for seen in _play(make(['twice', 'velocity'])):
    assert seen.keys() == _keys(['twice', 'velocity'])
    np.testing.assert_array_equal(
        seen['senses/twice'], 2 * seen['senses/velocity'][..., :1]
    )


def test_a_foreign_task_offers_its_enabled_observables():
  def load(selected: Any, **options: Any) -> Any:
    task = helpers.PointTask()
    calls: list[int] = []
    task.bead = observable.Generic(lambda physics: calls.append(1) or [1.0])
    task.secret.enabled = task.bead.enabled = True
    env = suite.embed(task, 'none', random=1, senses=selected, **options)
    return env, calls

  env, calls = load(['secret'])
  env.reset()
  seen = env.step(np.zeros(1)).observation
  assert seen.keys() == {'senses/secret'}
  assert not calls
  env, calls = load(None)
  assert set(env.senses) == {'bead', 'secret', 'time_left'}
  seen = env.reset().observation
  assert seen['senses/bead'] == 1.0
  assert calls
  with pytest.raises(
      errors.SpecError, match=r"'nose'.; this world offers .'bead', 'secret'"
  ):
    load(['nose'])

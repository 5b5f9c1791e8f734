"""Tests of the selection of senses: in one world, in batches and elsewhere."""

import functools
from typing import Any

from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
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


def test_senses_are_the_default_ones_unless_some_are_selected():
  env = _load()
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
    ('senses', 'complaint'),
    [
        (['nose'], "unknown ['nose']; this world offers ['ray_distances', "),
        (['camera', 'camera'], 'must be a list of names, each once'),
        ('camera', 'must be a list of names'),
        ([], 'none are selected, and the agent reads no register; must be'),
    ],
)
def test_wrong_senses_are_refused_in_one_line(senses, complaint):
  with pytest.raises(errors.SpecError) as raised:
    # Without a register that the agent reads, it would observe nothing.
    suite.load('unlock_door', 'near', None, {'senses': senses}, design=None)
  [line] = str(raised.value).splitlines()
  assert line.startswith('senses: ')
  assert complaint in line
  if complaint.startswith(('unknown', 'none')):
    assert "'camera', 'time_left']" in line


@pytest.mark.parametrize(
    ('design', 'provider'),
    [
        ('online_imitation', r'providers\[0\]:demonstration'),
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

"""A provider that is attached by itself, in plain environments of Composer."""

import itertools
from typing import Any, ClassVar, Literal

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import arenas
from realab_suite.entities import meters
from realab_suite.entities import registers
from realab_suite.feedback import provider_entities
from realab_suite.feedback import providers
from realab_suite.policies import random_keys
from realab_suite.tasks import unlock_door
from tests.engine import helpers
from tests.feedback import stubs

_TIMESTEP = 0.05
# What is measured at the end of each control step.
_VALUES = [1.0, 4.0, 2.0, 2.0, 7.0, 5.0]
_DIFFERENCES = np.diff(_VALUES, prepend=0.0)
_Provider = provider_entities.FeedbackProvider


class _Own(stubs.Zero):
  """Adds noise and a count of its steps; silent in the second step."""

  kind: Literal['attached_own'] = 'attached_own'
  bad: bool = False

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape)

  def step(self, *inputs: Any) -> tuple[dict[str, Any], Any]:
    *_, key, state = inputs
    if state == 1:
      return {}, state + 1
    value = np.nan if self.bad else state + random_keys.uniform(key)
    return dict.fromkeys(self.writes, value), state + 1


class _Blind(_Own):
  kind: Literal['attached_blind'] = 'attached_blind'
  required_senses: ClassVar = ('camera',)


@pytest.fixture(name='registered', autouse=True)
def fixture_registered():
  with (
      helpers.registered(providers.PROVIDERS, 'attached_own', _Own),
      helpers.registered(providers.PROVIDERS, 'attached_blind', _Blind),
  ):
    yield


def _value(physics: Any) -> float:
  return _VALUES[round(physics.time() / _TIMESTEP) - 1]


def _register(
    name: str, kind: Any = registers.TwoBlockRegister, **options: Any
) -> registers.Register:
  return kind(name, **{'value_range': (-20, 20), **options})


def _task(used: Any, parts: Any) -> composer.Task:
  """Returns a task with registers, and what is attached by itself."""
  arena = arenas.OpenRoom()
  for i, register in enumerate(used):
    register.attach_to(arena, (0.0, i - 2.0))
  for part in parts:
    arena.attach(part)
  task = composer.NullTask(arena)
  task.set_timesteps(_TIMESTEP, 0.01)
  return task


def _make(task: composer.Task, seed: int = 1) -> composer.Environment:
  return composer.Environment(
      task, random_state=seed, strip_singleton_obs_buffer_dim=True
  )


def _step(env: Any) -> Any:
  return env.step(np.zeros(env.action_spec().shape))


def _play(task: composer.Task, *read: Any, seed: int = 1) -> np.ndarray:
  """Returns the readings after each step of two episodes."""
  env, rows = _make(task, seed), []
  for _ in range(2):
    env.reset()
    for _ in _VALUES:
      _step(env)
      rows.append([register.read(env.physics) for register in read])
  return np.array(rows).reshape((2, len(_VALUES), -1))


# In some of them, each part is before each other one.
@pytest.mark.parametrize(
    'order', [*itertools.permutations(range(4))][::-3], ids=str
)
def test_a_provider_reads_what_meters_wrote_whatever_the_order(order):
  score, aside = _register('score'), _register('aside')
  reward, copy = _register('reward'), _register('copy', role='memory')
  parts = [
      meters.Meter(_value, score),
      meters.Meter(lambda physics: 2 * _value(physics), aside),
      _Provider('difference', [score], [reward]),
      _Provider({'kind': 'relay', 'every': 2}, [aside], [copy]),
  ]
  task = _task([score, aside, reward, copy], [parts[i] for i in order])
  for episode in _play(task, reward, copy):
    np.testing.assert_allclose(episode[:, 0], _DIFFERENCES, atol=1e-6)
    held = 2.0 * np.array(_VALUES)[[0, 0, 2, 2, 4, 4]]
    np.testing.assert_allclose(episode[:, 1], held, atol=1e-4)


def test_a_provider_after_another_reads_what_that_one_wrote():
  score, reward, sum_ = map(_register, ('score', 'reward', 'sum'))
  parts = [
      _Provider('difference', [score], [reward]),
      _Provider({'kind': 'growth', 'weights': [0.5]}, [reward], [sum_]),
      meters.Meter(_value, score),
  ]
  found = _play(_task([score, reward, sum_], parts), sum_)[1, :, 0]
  expected = 0.5 * np.diff(_DIFFERENCES, prepend=0.0)
  np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_register_of_several_numbers_is_read_and_written():
  values = _register('values', registers.Abacus2)
  copies = _register('copies', registers.Abacus2)
  total = _register('total')
  parts = [
      _Provider('growth', [values], [total]),
      _Provider({'kind': 'constant', 'value': 3.0}, [], [copies]),
  ]
  env = _make(_task([values, copies, total], parts))
  env.reset()
  values.write(env.physics, np.array([2.0, 5.0]))
  _step(env)
  assert float(total.read(env.physics)) == pytest.approx(7.0, abs=1e-2)
  np.testing.assert_allclose(copies.read(env.physics), 3.0, atol=1e-6)


def _noisy(order: str, seed: int = 1) -> np.ndarray:
  used = {name: _register(name) for name in 'ab'}
  parts = [_Provider('attached_own', [], [used[name]]) for name in order]
  return _play(_task(used.values(), parts), *used.values(), seed=seed)


def test_noise_and_state_belong_to_the_episode_and_the_provider():
  noisy = _noisy('ab')
  np.testing.assert_array_equal(_noisy('ab'), noisy)
  np.testing.assert_allclose(_noisy('ba'), noisy, atol=1e-9)
  assert not np.allclose(_noisy('ab', seed=2), noisy)
  assert not np.allclose(noisy[0], noisy[1])
  assert not np.allclose(noisy[..., 0], noisy[..., 1])
  # Each episode begins with the first step, and the second one is silent.
  assert (noisy[:, 0] < 1.0).all()
  np.testing.assert_allclose(noisy[:, 1], noisy[:, 0], atol=1e-4)
  assert (noisy[:, 2] > 2.0).all()


def test_what_was_written_is_an_observable_for_evaluators_alone():
  score, reward = _register('score'), _register('reward', value_range=(-2, 3))
  provider = _Provider('difference', [score], [reward])
  meter = meters.Meter(_value, score)
  task = _task([score, reward], [provider, meter])
  assert _make(task).observation_spec() == {}
  provider.observables.enable_all()
  env = _make(task)
  env.reset()
  for expected in (1.0, 3.0, -2.0):
    found = _step(env).observation
    assert dict(found) == {'provider_reward/written_reward': expected}
    reward.blocks[1].slide(env.physics, np.array(0.1))  # It is no reading.
  meter.observables.enable_all()
  agents = suite.embed(task, {'schema': 1, 'name': 'none'}, random=1)
  assert [*agents.reset().observation] == ['senses/time_left']
  _step(agents)
  assert float(reward.applied(agents.physics)) == 1.0


def test_observables_of_loaded_worlds_do_not_reach_the_agent():
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, design='instantaneous_reward'
  )
  before = {*env.reset().observation}
  written = []
  for entity in env.task.root_entity.iter_entities():
    entity.observables.enable_all()
    written += entity.observables.as_dict()
  assert any('written_reward' in name for name in written)
  assert {*env.reset().observation} == before
  assert {*_step(env).observation} == before


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda a, b: ('attached_blind', [a], [b]), "needs the sense 'camera'"),
        (
            lambda a, b: ('relay', [_register('q', role='query')], [b]),
            "needs the query 'q' of an action",
        ),
        (
            lambda a, b: (
                {'kind': 'demonstration', 'policy': 'random'}, [], [b]
            ),
            'needs the action, which',
        ),
        (lambda a, b: ({'kind': 'nothing'}, [a], [b]), "kind 'nothing' is"),
        (lambda a, b: ({'kind': []}, [a], [b]), 'must be a kind'),
        (lambda a, b: (3, [a], [b]), 'FeedbackProvider: 3; must be a kind'),
        (lambda a, b: ('relay', a, [b]), 'reads: .*; must be a list of reg'),
        (lambda a, b: ('relay', [a], ['b']), 'writes: .*; must be a list of'),
        (lambda a, b: ('relay', [a, b], [b]), 'reads'),
        (lambda a, b: ('relay', [_register('b')], [b]), 'a name in common'),
        (lambda a, b: ('relay', [b], [a]), "register 'a' has role 'meter'"),
        (lambda a, b: ({'kind': 'relay', 'reads': ['z']}, [a], [b]), 'must be'),
        (lambda a, b: ({'kind': 'relay', 'often': 1}, [a], [b]), "'often'"),
    ],
)  # fmt: skip
def test_a_provider_that_cannot_act_by_itself_is_refused(make, message):
  spec, *used = make(_register('a', role='meter'), _register('b'))
  with pytest.raises(errors.RealabError, match=message) as caught:
    _Provider(spec, *used)
  assert '\n' not in str(caught.value)


def test_a_wrong_world_is_refused():
  score, reward = _register('score', role='meter'), _register('reward')
  provider = _Provider('difference', [score], [reward])
  task = _task([score], [provider])
  with pytest.raises(errors.SpecError, match="'reward' is not in the world"):
    _make(task)
  arena = task.root_entity
  reward.attach_to(arena, (1.0, 1.0))
  with pytest.raises(ValueError, match='already attached'):
    arena.attach(provider)
  first = _make(task)
  first.reset()
  _make(task)
  with pytest.raises(errors.SpecError, match='is in two environments'):
    _step(first)
  for other in (
      meters.Meter(_value, reward),
      _Provider('constant', [], [reward]),
  ):
    arena.attach(other)
    with pytest.raises(errors.SpecError, match="'reward' has another writer"):
      _make(task)
    other.detach()


def test_a_register_has_one_meter():
  score = _register('score', role='meter')
  task = _task([score], [meters.Meter(_value, score)])
  _make(task).reset()
  task.root_entity.attach(meters.Meter(_value, score))
  with pytest.raises(errors.SpecError, match="'score' has 2 meters in the wor"):
    _make(task)


def test_a_loaded_world_refuses_it():
  task, reward = unlock_door.UnlockDoor(), _register('reward')
  reward.attach_to(task.root_entity, (1.0, -2.0))
  task.root_entity.attach(_Provider('constant', [], [reward]))
  with pytest.raises(errors.SpecError, match='must be in the design of Unlock'):
    suite.embed(task, {'schema': 1, 'name': 'none'})


def test_a_value_that_is_not_finite_names_the_provider_and_the_register():
  reward = _register('reward')
  spec = {'kind': 'attached_own', 'bad': True}
  env = _make(_task([reward], [_Provider(spec, [], [reward])]))
  env.reset()
  with pytest.raises(
      errors.RegisterValueError,
      match=r"^provider_reward:attached_own at step 1: .*'reward'.*nan",
  ):
    _step(env)

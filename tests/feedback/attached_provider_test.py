"""A provider that is attached by itself, in plain environments of Composer."""

import itertools
from typing import Any, Literal

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

_VALUES = [1.0, 4.0, 2.0, 2.0, 7.0, 5.0]


class _Own(providers.Provider):
  """Adds noise and a count of its steps; silent in the second step."""

  kind: Literal['attached_own'] = 'attached_own'
  bad: bool = False

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape)

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: Any,
      key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:
    if state == 1:
      return {}, state + 1
    value = np.nan if self.bad else state + random_keys.uniform(key)
    return dict.fromkeys(self.writes, value), state + 1


class _Blind(_Own):
  kind: Literal['attached_blind'] = 'attached_blind'

  @property
  def required_senses(self) -> tuple[str, ...]:
    return ('camera',)


@pytest.fixture(name='registered', autouse=True)
def fixture_registered():
  with (
      helpers.registered(providers.PROVIDERS, 'attached_own', _Own),
      helpers.registered(providers.PROVIDERS, 'attached_blind', _Blind),
  ):
    yield


class _Task(composer.NullTask):
  """Has a value for each control step, which the meters measure."""

  def __init__(self, root: composer.Entity) -> None:
    super().__init__(root)
    self.step = 0
    self.set_timesteps(control_timestep=0.05, physics_timestep=0.01)

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.step = 0

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    self.step += 1

  def value(self, physics: Any) -> float:
    return _VALUES[self.step - 1]


def _register(
    name: str, kind: Any = registers.TwoBlockRegister, **options: Any
):
  return kind(name, **{'value_range': (-20, 20), **options})


class _World:
  """Registers in a room, with their task."""

  def __init__(self, *used: Any) -> None:
    self.arena = arenas.OpenRoom()
    for i, register in enumerate(used):
      register.attach_to(self.arena, (0.0, i - 2.0))
    self.task = _Task(self.arena)

  def attach(self, *entities: composer.Entity) -> None:
    for entity in entities:
      self.arena.attach(entity)

  def make(self, seed: int = 1, **options: Any) -> composer.Environment:
    return composer.Environment(
        self.task, random_state=seed, strip_singleton_obs_buffer_dim=True,
        **options,
    )  # fmt: skip


def _play(env: composer.Environment, *registers_: Any) -> np.ndarray:
  """Returns the readings after each step of two episodes."""
  rows = []
  for _ in range(2):
    env.reset()
    for _ in _VALUES:
      env.step(np.zeros(env.action_spec().shape))
      rows.append([r.read(env.physics) for r in registers_])
  return np.array(rows).reshape((2, len(_VALUES), -1))


_DIFFERENCES = np.diff(_VALUES, prepend=0.0)


@pytest.mark.parametrize('order', [*itertools.permutations(range(4))], ids=str)
def test_a_provider_reads_what_meters_wrote_whatever_the_order(order):
  score, aside = _register('score'), _register('aside')
  reward, copy = _register('reward'), _register('copy', role='memory')
  world = _World(score, aside, reward, copy)
  make = provider_entities.FeedbackProvider
  parts = [
      meters.Meter(world.task.value, score),
      meters.Meter(lambda physics: 2 * world.task.value(physics), aside),
      make('difference', [score], [reward]),
      make({'kind': 'relay', 'every': 2}, [aside], [copy]),
  ]
  world.attach(*(parts[i] for i in order))
  found = _play(world.make(), reward, copy)
  for episode in found:
    np.testing.assert_allclose(episode[:, 0], _DIFFERENCES, atol=1e-6)
    held = 2.0 * np.array(_VALUES)[[0, 0, 2, 2, 4, 4]]
    np.testing.assert_allclose(episode[:, 1], held, atol=1e-4)


def test_a_provider_after_another_reads_what_that_one_wrote():
  score, reward, sign = (
      _register(name) for name in ('score', 'reward', 'sign')
  )
  world = _World(score, reward, sign)
  make = provider_entities.FeedbackProvider
  world.attach(
      make('difference', [score], [reward]),
      make({'kind': 'growth', 'weights': [2.0]}, [reward], [sign]),
      meters.Meter(world.task.value, score),
  )
  found = _play(world.make(), sign)[1, :, 0]
  expected = 2.0 * np.diff(_DIFFERENCES, prepend=0.0)
  np.testing.assert_allclose(found, np.clip(expected, -20, 20), atol=1e-5)


def test_a_register_of_several_numbers_is_read_and_written():
  values = _register('values', registers.Abacus2)
  copies = _register('copies', registers.Abacus2)
  total = _register('total')
  world = _World(values, copies, total)
  make = provider_entities.FeedbackProvider
  world.attach(
      make('growth', [values], [total]),
      make({'kind': 'constant', 'value': 3.0}, [], [copies]),
  )
  env = world.make()
  env.reset()
  values.write(env.physics, np.array([2.0, 5.0]))
  env.step(np.zeros(env.action_spec().shape))
  assert float(total.read(env.physics)) == pytest.approx(7.0, abs=1e-2)
  np.testing.assert_allclose(copies.read(env.physics), 3.0, atol=1e-6)


def _noisy(first: str, second: str, seed: int = 1) -> np.ndarray:
  used = {'a': _register('a'), 'b': _register('b')}
  world = _World(*used.values())
  for name in (first, second):
    world.attach(
        provider_entities.FeedbackProvider('attached_own', [], [used[name]])
    )
  return _play(world.make(seed), *used.values())


def test_noise_and_state_belong_to_the_episode_and_the_provider():
  noisy = _noisy('a', 'b')
  np.testing.assert_array_equal(_noisy('a', 'b'), noisy)
  np.testing.assert_allclose(_noisy('b', 'a'), noisy, atol=1e-9)
  assert not np.allclose(_noisy('a', 'b', seed=2), noisy)
  assert not np.allclose(noisy[0], noisy[1])
  assert not np.allclose(noisy[..., 0], noisy[..., 1])
  # Each episode begins with the first step, and the second one is silent.
  assert (noisy[:, 0] < 1.0).all()
  np.testing.assert_allclose(noisy[:, 1], noisy[:, 0], atol=1e-4)
  assert (noisy[:, 2] > 2.0).all()


def test_what_was_written_is_an_observable_for_evaluators_alone():
  score, reward = _register('score'), _register('reward', value_range=(-2, 3))
  world = _World(score, reward)
  provider = provider_entities.FeedbackProvider('difference', [score], [reward])
  meter = meters.Meter(world.task.value, score)
  world.attach(provider, meter)
  assert world.make().observation_spec() == {}
  provider.observables.enable_all()
  env = world.make()
  env.reset()
  for expected in (1.0, 3.0, -2.0):
    found = env.step(np.zeros(env.action_spec().shape)).observation
    assert dict(found) == {'provider_reward/written_reward': expected}
    reward.blocks[1].slide(env.physics, np.array(0.1))  # It is no reading.
  meter.observables.enable_all()
  world.arena.observables.enable_all()
  agents = suite.embed(world.task, {'schema': 1, 'name': 'none'}, random=1)
  assert [*agents.reset().observation] == ['senses/time_left']
  agents.step(np.zeros(agents.action_spec().shape))
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
  assert {*env.step(env.action_spec().generate_value()).observation} == before


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda a, b: ('attached_blind', [a], [b]), "needs the sense 'camera'"),
        (lambda a, b: ({'kind': 'nothing'}, [a], [b]), "kind 'nothing' is"),
        (lambda a, b: (3, [a], [b]), 'FeedbackProvider: 3; must be a kind'),
        (lambda a, b: ({'kind': []}, [a], [b]), 'must be a kind'),
        (lambda a, b: ('relay', a, [b]), 'reads: .*; must be a list of reg'),
        (lambda a, b: ('relay', [a], ['b']), 'writes: .*; must be a list of'),
        (lambda a, b: ('relay', [a, b], [b]), 'reads'),
        (lambda a, b: ('relay', [_register('b')], [b]), 'a name in common'),
        (lambda a, b: ('relay', [b], [a]), "register 'a' has role 'meter'"),
        (lambda a, b: ({'kind': 'relay', 'reads': ['z']}, [a], [b]), "must be"),
        (lambda a, b: ({'kind': 'relay', 'often': 1}, [a], [b]), "'often'"),
        (
            lambda a, b: (
                {'kind': 'demonstration', 'policy': 'random'}, [], [b]
            ),
            'needs the action, which',
        ),
        (
            lambda a, b: ('relay', [_register('q', role='query')], [b]),
            "needs the query 'q' of an action",
        ),
    ],
)  # fmt: skip
def test_a_provider_that_cannot_act_by_itself_is_refused(make, message):
  spec, *used = make(_register('a', role='meter'), _register('b'))
  with pytest.raises(errors.RealabError, match=message) as caught:
    provider_entities.FeedbackProvider(spec, *used)
  assert '\n' not in str(caught.value)


def test_a_wrong_world_is_refused():
  score, reward = _register('score', role='meter'), _register('reward')
  world = _World(score)
  make = provider_entities.FeedbackProvider
  provider = make('difference', [score], [reward])
  world.attach(provider)
  with pytest.raises(errors.SpecError, match="'reward' is not in the world"):
    world.make()
  reward.attach_to(world.arena, (1.0, 1.0))
  world.make()
  with pytest.raises(ValueError, match='already attached'):
    world.attach(provider)
  for other in (
      meters.Meter(world.task.value, reward),
      make('constant', [], [reward]),
  ):
    world.arena.attach(other)
    with pytest.raises(errors.SpecError, match="'reward' has another writer"):
      world.make()
    other.detach()


def test_two_environments_of_one_task_and_a_loaded_world_are_refused():
  reward = _register('reward')
  world = _World(reward)
  world.attach(provider_entities.FeedbackProvider('constant', [], [reward]))
  first = world.make()
  first.reset()
  world.make()
  with pytest.raises(errors.SpecError, match='is in two environments'):
    first.step(np.zeros(first.action_spec().shape))
  task = unlock_door.UnlockDoor()
  other = _register('other')
  other.attach_to(task.root_entity, (1.0, -2.0))
  task.root_entity.attach(
      provider_entities.FeedbackProvider('constant', [], [other])
  )
  with pytest.raises(errors.SpecError, match='must be in the design of Unlock'):
    suite.embed(task, 'instantaneous_reward')


def test_a_value_that_is_not_finite_names_the_provider_and_the_register():
  reward = _register('reward')
  world = _World(reward)
  spec = {'kind': 'attached_own', 'bad': True}
  world.attach(provider_entities.FeedbackProvider(spec, [], [reward]))
  env = world.make()
  env.reset()
  with pytest.raises(
      errors.RegisterValueError,
      match=r"^provider_reward:attached_own at step 1: .*'reward'.*nan",
  ):
    env.step(np.zeros(env.action_spec().shape))

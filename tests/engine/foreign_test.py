"""An embedded task of dm_control gives what `composer.Environment` gives."""

from collections.abc import Callable
import functools
from typing import Any

from dm_control import composer
import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from realab_suite.tasks import registry
from tests import examples
from tests.engine import embedded
from tests.engine import helpers

pytestmark = pytest.mark.slow

_SEED = 11
_REGISTER = {
    'kind': 'two_block',
    'role': 'feedback',
    'place': [3.0, 3.0],
    'range': [-2, 12],
}


def _composer(task: composer.Task) -> tuple[composer.Environment, Any]:
  random_state = seeding.random_state(_SEED, 0, 0, 'construction')
  stock = composer.Environment(
      task, random_state=random_state, strip_singleton_obs_buffer_dim=True
  )
  return stock, random_state


def _bytes(time_step: dm_env.TimeStep, reward: Any) -> list[Any]:
  """Returns all of a time step, with its reward, canonically."""
  discount = time_step.discount
  return [
      int(time_step.step_type),
      None if reward is None else np.float64(reward).tobytes(),
      None if discount is None else np.float64(discount).tobytes(),
      {
          key.removeprefix('senses/'): (
              np.asarray(value).dtype.str,
              np.shape(value),
              np.asarray(value).tobytes(),
          )
          for key, value in time_step.observation.items()
      },
  ]


def _assert_identical(
    make: Callable[[], composer.Task], num_steps: int, num_episodes: int = 2
) -> list[int]:
  """Plays a task both ways; returns the step types that came up."""
  stock, random_state = _composer(make())
  env = suite.embed(make(), 'none', random=_SEED, max_steps=None)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  expected_spec = stock.observation_spec()
  found_spec = env.observation_spec()
  assert set(found_spec) == {f'senses/{key}' for key in expected_spec}
  generator = np.random.default_rng(0)
  spec = stock.action_spec()
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
  seen = []
  for episode in range(num_episodes):
    seeding.reseed(random_state, _SEED, 0, episode, 'reset/0')
    expected, time_step = embedded.lucky(stock.reset), embedded.lucky(env.reset)
    assert _bytes(time_step, None) == _bytes(expected, None)
    for _ in range(num_steps):
      action = generator.uniform(low, high).astype(spec.dtype)
      expected, time_step = (
          embedded.lucky(functools.partial(one.step, action))
          for one in (stock, env)
      )
      reward = ledger.last.true_rewards[-1]
      assert _bytes(time_step, reward) == _bytes(expected, expected.reward)
      assert time_step.reward == 0.0
      seen.append(int(time_step.step_type))
      if time_step.last():
        break
    assert time_step.last() == (ledger.last.end is events.End.TERMINATED)
  stock.close()
  env.close()
  return seen


# Half of them, with walkers and arms of each kind; in the profile `long`, all.
@pytest.mark.parametrize(
    'name', [*embedded.COMPOSER_TASKS][:: 1 if examples.IS_LONG else 2]
)
def test_an_embedded_task_equals_composer_bit_for_bit(name: str):
  assert _assert_identical(
      functools.partial(embedded.make_composer, name), num_steps=8
  )


@pytest.mark.parametrize(
    'name', ['humanoid in a corridor', 'single goal maze that ends at once']
)
def test_episodes_that_the_task_ends_end_as_in_composer(name: str):
  seen = _assert_identical(
      functools.partial(embedded.make_composer, name), num_steps=400
  )
  assert 2 in seen


def _small_actions(env: Any, number: int) -> list[np.ndarray]:
  spec = env.action_spec()
  generator = np.random.default_rng(0)
  low, high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
  return [generator.uniform(low, high) for _ in range(number)]


# Places of registers at which nothing touches them, where [3, 3] is none, and
# scales at which their values fit there. The first cell of a maze is free.
_PLACES = {
    'walls corridor': ([4.0, 2.0], 0.05),
    'single goal maze': ([0.0, 0.0], 0.01),
}


# Arenas with walls and without, and two manipulations.
@pytest.mark.parametrize(
    'name',
    [
        *_PLACES,
        'go to a moving target',
        'reach a brick',
        'stack on a movable base',
    ],
)
def test_what_a_task_observes_does_not_depend_on_registers_nearby(name: str):
  place, scale = _PLACES.get(name, ([3.0, 3.0], 0.1))
  register = _REGISTER | {'place': place, 'scale': scale}
  design: Any = {
      'schema': 1,
      'name': 'd',
      'registers': {'r': register},
      'providers': [{'kind': 'constant', 'writes': ['r'], 'value': 1.0}],
  }
  runs: list[list[Any]] = []
  for with_register in (False, True):
    env = suite.embed(
        embedded.make_composer(name),
        design if with_register else 'none',
        random=_SEED,
        max_steps=None,
    )
    ledger = ledgers.Ledger()
    env.add_sink(ledger)
    actions = _small_actions(env, 6)
    time_steps = [embedded.lucky(env.reset)]
    time_steps += [
        embedded.lucky(functools.partial(env.step, action))
        for action in actions
    ]
    runs.append([t.observation for t in time_steps])
    rewards = ledger.last.true_rewards
    runs[-1].append({'senses/reward': np.array(rewards)})
    env.close()
  for bare, beside in zip(*runs, strict=True):
    for key, value in bare.items():
      np.testing.assert_allclose(
          beside[key], value, rtol=1e-3, atol=1e-3, err_msg=key
      )


def test_a_batch_is_refused_with_the_remedy():
  name = ('floor', 'go_to_target')
  suite.register_task(*name)(lambda: embedded.make_composer('go to target'))
  try:
    with pytest.raises(
        errors.SpecError, match=r'keeps state in Python.*with world=i instead'
    ):
      suite.load_batch(*name, num_envs=2)
    assert suite.load(*name, {'random': 1}, {'world': 1}).reset().first()
  finally:
    del registry._TASKS[name]


class _Curious(events.EventSink):
  """Reads what derives from the state, at every opportunity."""

  def __init__(self, env: Any) -> None:
    root = env.task.root_entity.mjcf_model
    self._bodies = root.find_all('body')
    self.num_looks = 0

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self._look(physics)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self._look(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _look(self, physics: Any) -> None:
    assert np.isfinite(physics.bind(self._bodies).xpos).all()
    self.num_looks += 1


def test_a_sink_that_looks_changes_nothing():
  design: Any = {
      'schema': 1,
      'name': 'd',
      'registers': {'r': _REGISTER},
      'providers': [{'kind': 'constant', 'writes': ['r'], 'value': 1.0}],
  }

  def play(is_watched: bool) -> list[bytes]:
    env = suite.embed(
        embedded.make_composer('go to target'),
        design,
        random=2,
        max_steps=None,
    )
    if is_watched:
      sink = _Curious(env)
      env.add_sink(sink)
    actions = helpers.random_actions(env, 20)
    encoded = [helpers.to_bytes(embedded.lucky(env.reset))]
    encoded += [helpers.to_bytes(env.step(action)) for action in actions]
    env.close()
    assert not is_watched or sink.num_looks == 21
    return encoded

  assert play(is_watched=True) == play(is_watched=False)

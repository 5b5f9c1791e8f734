"""An embedded task of dm_control gives what `composer.Environment` gives."""

import functools
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
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


# Half of them, with walkers and arms of each kind; in the profile `long`, all.
@pytest.mark.parametrize(
    'name', [*embedded.COMPOSER_TASKS][:: 1 if examples.IS_LONG else 2]
)
def test_an_embedded_task_equals_composer_bit_for_bit(name: str):
  assert embedded.assert_identical(
      functools.partial(embedded.make_composer, name), num_steps=8
  )


@pytest.mark.parametrize(
    'name', ['humanoid in a corridor', 'single goal maze that ends at once']
)
def test_episodes_that_the_task_ends_end_as_in_composer(name: str):
  seen = embedded.assert_identical(
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
      suite.load_batch(*name, num_envs=2, design=None)
    assert (
        suite.load(*name, {'random': 1}, {'world': 1}, design=None)
        .reset()
        .first()
    )
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

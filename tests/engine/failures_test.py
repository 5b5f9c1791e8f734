"""Tests that the evaluator gets each failure, with its step and its world."""

from typing import Any, Literal

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.evaluation import evaluate
from realab_suite.feedback import providers
from realab_suite.tasks import collect_apples
from tests.engine import helpers

_NUM_ENVS = 3


class _Unpaid(collect_apples.CollectApples):
  """Fails to give a reward from the second step on."""

  def get_reward(self, physics: Any) -> Any:
    reward = super().get_reward(physics)
    if np.max(self.steps(physics)) >= 1:
      raise ZeroDivisionError('the till is empty')
    return reward


def _embed(task: Any, max_steps: int = 4) -> Any:
  env = suite.embed(task, 'none', random=1, max_steps=max_steps)
  task.steps = env.mechanism.step_count
  return env


def _failing_point() -> helpers.PointTask:
  task = helpers.PointTask()

  def fail(physics: Any) -> float:
    raise ZeroDivisionError('the till is empty')

  task.reward = fail
  return task


@pytest.mark.parametrize('make', [_Unpaid, _failing_point])
def test_a_failing_reward_is_reported_with_its_traceback(make: Any):
  env = _embed(make())
  (result,) = evaluate.evaluate(env, lambda time_step: helpers.no_op(env), 1)
  assert result.end is events.End.TIMEOUT
  assert not result.is_valid
  assert np.isnan(result.true_return)
  assert 'ZeroDivisionError: the till is empty' in result.failure
  assert 'Traceback' in result.failure
  assert make.__module__.rpartition('.')[2] in result.failure


def _batch(**kwargs: Any) -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'collect_apples', 'near', {'random': 1}, {'max_steps': 6},
      num_envs=_NUM_ENVS, **kwargs,
  )  # fmt: skip


# Providers that fail in a batch.

_ANSWER: list[Any] = []


class _Scripted(providers.Provider):
  """Does what a test says, with what it gets."""

  kind: Literal['failing_in_a_test'] = 'failing_in_a_test'

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return _ANSWER[0](batch_shape)

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> Any:  # fmt: skip
    return _ANSWER[1](episode_start, state)


_DESIGN: dict[str, Any] = {
    'schema': 1,
    'name': 'failing',
    'registers': {
        'reward': {
            'kind': 'two_block',
            'role': 'feedback',
            'place': 'station_1',
            'range': [-2, 12],
        },
    },
    'providers': [{'kind': 'failing_in_a_test', 'writes': ['reward']}],
}


@pytest.fixture(name='scripted', scope='module')
def fixture_scripted() -> Any:
  """Returns worlds whose provider does what `_ANSWER` says."""
  with helpers.registered(providers.PROVIDERS, 'failing_in_a_test', _Scripted):
    _ANSWER[:] = [_states, _counting(0.0)]
    yield _batch(design=_DESIGN)


def _states(shape: tuple[int, ...]) -> Any:
  return np.zeros(shape)


def _counting(wrong: Any) -> Any:
  """Returns an answer that is wrong in world 1, in its third step."""

  def answer(episode_start: Any, state: Any) -> Any:
    state = np.where(episode_start, 1.0, state + 1.0)
    value = np.zeros(np.shape(state))
    if np.ndim(value):
      value[1] = wrong if state[1] == 3 else 0.0
    return {'reward': value}, state

  return answer


def _play(batch: Any, num_steps: int) -> None:
  spec = batch.action_spec()
  for _ in range(num_steps):
    batch.step(np.zeros((batch.num_envs, *spec.shape)))


def test_an_error_of_a_write_names_the_step_and_the_world(scripted: Any):
  _ANSWER[:] = [_states, _counting(np.nan)]
  batch = scripted
  batch.reset()
  # World 0 is two steps ahead of the others.
  batch.mechanism._counters.of(batch.physics).step_count[:] = [2.0, 0.0, 0.0]
  with pytest.raises(errors.RegisterValueError) as caught:
    _play(batch, 3)
  assert str(caught.value).startswith(
      'providers[0]:failing_in_a_test at step 3 of world 1: register'
      " 'reward': cannot store nan"
  )
  assert caught.value.world == 1


_ANSWERS = {
    'raises': (
        lambda start, state: 1 / 0,
        'at step 1 in a batch of 3 worlds: ZeroDivisionError',
    ),
    'one value for all worlds': (
        lambda start, state: ({'reward': 1.0}, state),
        "wrote shape () to 'reward'; must be (3,)",
    ),
    'a masked array': (
        lambda start, state: ({'reward': np.ma.zeros(3)}, state),
        'must be plain numbers',
    ),
}


@pytest.mark.parametrize(
    ('answer', 'message'), _ANSWERS.values(), ids=list(_ANSWERS)
)
def test_an_invalid_result_of_a_provider_names_the_step(
    scripted: Any, answer: Any, message: str
):
  _ANSWER[:] = [_states, answer]
  batch = scripted
  batch.reset()
  with pytest.raises(errors.FeedbackProviderError) as caught:
    _play(batch, 1)
  assert message in str(caught.value)
  assert str(caught.value).startswith('providers[0]:failing_in_a_test')
  assert '\n' not in str(caught.value)


def test_a_state_that_changes_its_structure_is_refused(scripted: Any):
  _ANSWER[:] = [
      lambda shape: (np.zeros(shape),),
      lambda start, state: ({'reward': np.zeros(3)}, (np.zeros(2),)),
  ]
  batch = _batch(design=_DESIGN)
  batch.reset()
  with pytest.raises(
      errors.FeedbackProviderError,
      match=r'state of providers\[0\].*must have the structure',
  ):
    _play(batch, 8)  # Two more than an episode has.

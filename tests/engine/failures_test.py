"""Tests that the evaluator gets each failure, with its step and its world."""

from typing import Any, Literal

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import provider_results
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


def test_a_row_contains_the_traceback(tmp_path: Any):
  env = _embed(_failing_point())
  (result,) = evaluate.evaluate(env, lambda time_step: np.zeros(1), 1)
  info = results.RunInfo.of(
      ('d', 't'), (1, None), env.mechanism.design, policy='p', run='r',
      baseline=None, control_timestep=0.1, max_steps=4,
  )  # fmt: skip
  env.close()
  with results.RowWriter(tmp_path / 'rows.jsonl') as writer:
    writer.write(result.of_run(info))
  (row,) = results.read_rows(tmp_path / 'rows.jsonl')
  assert row.failure == result.failure


def test_a_failing_reward_is_reported_for_every_world_of_a_batch():
  batch = batch_environment.BatchEnvironment(_embed(_Unpaid()), _NUM_ENVS)
  actor = batch_actors.BatchPolicyActor(policies.make('random'), batch, 1)
  found = evaluate.evaluate_batch(batch, actor)
  for result in found:
    assert not result.is_valid
    assert 'ZeroDivisionError: the till is empty' in result.failure


# Ends that the engine tells, once.


class _Heard(events.BatchEventSink):
  """Counts beginnings and ends, as they are told."""

  def __init__(self) -> None:
    self.ends: list[tuple[int, events.End]] = []
    self.starts = 0

  def step_ended(self, step: events.BatchStep) -> None:
    self.starts += int(step.is_first.sum())
    self.ends += sorted(step.ends.items())

  def state(self, places: np.ndarray) -> list[Any]:
    return [None] * len(places)

  def set_state(self, places: np.ndarray, states: Any) -> None:
    """Nothing is kept."""


def _batch(**kwargs: Any) -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'collect_apples', 'near', {'random': 1}, {'max_steps': 6},
      num_envs=_NUM_ENVS, **kwargs,
  )  # fmt: skip


@pytest.mark.parametrize(
    ('how', 'num_steps'),
    [
        ('reset', 0), ('reset', 6), ('close', 5), ('add_sink', 8),
        ('restore', 6), ('restore', 7),
    ],
)  # fmt: skip
def test_every_episode_that_begins_ends_once(num_steps: int, how: str):
  batch, sink = _batch(design='instantaneous_reward'), _Heard()
  batch.add_sink(sink)
  batch.reset()
  for _ in range(num_steps):
    batch.step(np.zeros((_NUM_ENVS, 6)))
  restored = 0
  if how == 'reset':
    batch.reset()
  elif how == 'add_sink':
    batch.add_sink(_Heard())
  elif how == 'restore':
    restored = 0 if num_steps == 6 else _NUM_ENVS
    batch.restore(batch.save())
  batch.close()
  batch.close()
  assert len(sink.ends) == sink.starts + restored
  is_over = num_steps >= 6
  assert sink.ends[:_NUM_ENVS] == [
      (world, events.End.TIMEOUT if is_over else events.End.ABANDONED)
      for world in range(_NUM_ENVS)
  ]


def test_a_reset_that_fails_ends_the_episodes_before_it_once():
  batch, sink = _batch(), _Heard()
  batch.add_sink(sink)
  batch.reset()
  batch.task.initialize_episode = _fail  # type: ignore[method-assign]
  with pytest.raises(ZeroDivisionError):
    batch.reset()
  del batch.task.initialize_episode
  assert len(sink.ends) == _NUM_ENVS
  batch.step(np.zeros((_NUM_ENVS, 6)))
  batch.close()
  assert len(sink.ends) == sink.starts == 2 * _NUM_ENVS


def _fail(*unused: Any) -> None:
  raise ZeroDivisionError('oops')


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


@pytest.mark.parametrize('wrong', [np.nan, np.inf])
def test_an_error_of_a_write_names_the_step_and_the_world(
    scripted: Any, wrong: float
):
  _ANSWER[:] = [_states, _counting(wrong)]
  batch = scripted
  batch.reset()
  # World 0 is two steps ahead of the others.
  batch._mechanism._step_count.set(batch.physics, [2.0, 0.0, 0.0])
  with pytest.raises(errors.RegisterValueError) as caught:
    _play(batch, 3)
  assert str(caught.value).startswith(
      'providers[0]:failing_in_a_test at step 3 of world 1: register'
      f" 'reward': cannot store {wrong}"
  )
  assert caught.value.world == 1


def test_an_error_of_a_meter_names_the_step_and_the_world():
  batch = _batch(design='instantaneous_reward')
  batch.reset()
  batch.task._score.set(batch.physics, [0.0, 0.0, np.nan])
  with pytest.raises(errors.RegisterValueError) as caught:
    _play(batch, 1)
  assert 'meter:score at step 1 of world 2' in str(caught.value)
  assert 'nan' not in str(caught.value)


_ANSWERS = {
    'raises': (
        lambda start, state: 1 / 0,
        'at step 1 in a batch of 3 worlds: ZeroDivisionError',
    ),
    'one value for all worlds': (
        lambda start, state: ({'reward': 1.0}, state),
        "wrote shape () to 'reward'; allowed is (3,)",
    ),
    'a masked array': (
        lambda start, state: ({'reward': np.ma.zeros(3)}, state),
        'allowed are plain numbers',
    ),
    'masked values': (
        lambda start, state: (
            {'reward': np.ma.masked_equal(np.zeros(3), 0.0)},
            state,
        ),
        'allowed are plain numbers',
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


def test_an_error_names_the_range_of_steps_of_a_batch(scripted: Any):
  _ANSWER[:] = [_states, lambda start, state: 1 / 0]
  batch = scripted
  batch.reset()
  batch._mechanism._step_count.set(batch.physics, [4.0, 0.0, 2.0])
  with pytest.raises(
      errors.FeedbackProviderError,
      match='at steps 1 to 5 in a batch of 3 worlds',
  ):
    _play(batch, 1)


_STATES = {
    'an object': lambda shape: object(),
    'objects': lambda shape: np.full(shape, None),
    'one for all worlds': lambda shape: np.zeros(2),
    'a number': lambda shape: 0.0,
    'within': lambda shape: {'a': (np.zeros(shape), [object()])},
}


@pytest.mark.parametrize('state', _STATES.values(), ids=list(_STATES))
def test_a_state_without_an_axis_of_worlds_is_refused(
    scripted: Any, state: Any
):
  _ANSWER[:] = [state, lambda start, state: ({'reward': 0.0 * start}, state)]
  with pytest.raises(
      errors.FeedbackProviderError,
      match=r'before the first step: its state contains .*whose first axis',
  ):
    _batch(design=_DESIGN)


_OTHER_STATES = (object(), (np.zeros(2),), (np.zeros(3), np.zeros(3)), None)


def test_a_state_that_changes_its_structure_is_refused(scripted: Any):
  initial = (np.zeros(3),)
  message = r'state of providers\[0\].*allowed is the structure'
  for other in _OTHER_STATES:
    with pytest.raises(errors.FeedbackProviderError, match=message):
      provider_results.merged(
          'state of providers[0]', other, initial, np.array([1])
      )
  _ANSWER[:] = [
      lambda shape: (np.zeros(shape),),
      lambda start, state: ({'reward': np.zeros(3)}, _OTHER_STATES[1]),
  ]
  batch = _batch(design=_DESIGN)
  batch.reset()
  with pytest.raises(errors.FeedbackProviderError, match=message):
    _play(batch, 8)  # Two more than an episode has.

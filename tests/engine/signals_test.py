"""Readings of signal registers end episodes (G7, P6)."""

from collections.abc import Iterator
from typing import Any, Literal, final

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.leaks import views

_LAST = int(dm_env.StepType.LAST)
_ALARM_STEP = 3
_OPTIONS = {'role': 'signal', 'range': [0, 10], 'place': [1.4, -2.2]}


@final
class Alarm(providers.Provider):
  """Writes a value from a step on, and is silent before."""

  kind: Literal['test_alarm'] = 'test_alarm'
  value: float = 5.0
  start: int = _ALARM_STEP
  fails: bool = False

  def initial_state(self, batch_shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(batch_shape, int)

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: np.ndarray,
  ) -> tuple[dict[str, Any], np.ndarray]:
    step = np.where(episode_start, 1, state + 1)
    value = np.full(np.shape(step), np.nan if self.fails else self.value)
    return {name: (value, step >= self.start) for name in self.writes}, step


@pytest.fixture(autouse=True)
def fixture_alarm() -> Iterator[None]:
  with helpers.registered(providers.PROVIDERS, 'test_alarm', Alarm):
    yield


def _design(
    ends_episode: Any = None, alarm: Any = None, **options: Any
) -> dict[str, Any]:
  """Returns a design with the signal `stop`; 5 is written in step 3."""
  threshold = {'above': 2} if ends_episode is None else ends_episode
  design = helpers.one_register(
      'stop', **{**_OPTIONS, 'ends_episode': threshold, **options}
  )
  alarm = {'kind': 'test_alarm', 'writes': ['stop'], **(alarm or {})}
  return {**design, 'providers': [alarm]}


def _load(design: Any, num_envs: int = 0, max_steps: int | None = 20) -> Any:
  world = 'unlock_door', 'standard', {'random': 1}, {'max_steps': max_steps}
  if num_envs:
    return suite.load_batch(*world, num_envs=num_envs, design=design)
  return suite.load(*world, design=design)


def _play(env: Any, steps: int, num_envs: int = 0) -> list[Any]:
  shape = (*[num_envs] * bool(num_envs), *env.action_spec().shape)
  return [env.step(np.zeros(shape)) for _ in range(steps)]


def _ends(env: Any, steps: int, num_envs: int = 0) -> list[Any]:
  """Returns the step types and discounts of steps, and the ledgers' ends."""
  ledger = ledgers.BatchLedger() if num_envs else ledgers.Ledger()
  env.add_sink(ledger)
  played = _play(env, steps, num_envs)
  found = ledger.episodes(num_envs - 1) if num_envs else ledger.episodes
  ends = [episode.end for episode in found]
  last = [
      (float(np.max(step.discount)), i)
      for i, step in enumerate(played)
      if np.all(step.step_type == _LAST)
  ]
  env.close()
  return [*last, *ends]


def _push(env: Any, worlds: Any, distance: float) -> None:
  """Moves the base block of the signal along its axis in some worlds."""
  base = env.mechanism.registers['stop'].blocks[0]
  position = np.array(base.position(env.physics))
  position[..., 0][worlds] += distance
  base.put(env.physics, position)


@pytest.mark.parametrize(
    ('num_envs', 'channel', 'is_above'),
    [
        (0, 'embedded', True),
        (0, 'secure', False),
        (3, 'embedded', False),
    ],
)
def test_a_signal_ends_every_episode_with_discount_0(
    num_envs, channel, is_above
):
  threshold, initial, value = (
      ({'above': 2}, 0, 5) if is_above else ({'below': 2.5}, 4, 0)
  )
  design = _design(
      threshold, {'value': float(value)}, initial=initial, channel=channel,
      dof='planar' if num_envs else 'free',
  )  # fmt: skip
  found = _ends(_load(design, num_envs), 2 * (_ALARM_STEP + 1), num_envs)
  # Index 0 is the reset.
  assert found == [(0.0, 3), (0.0, 7), events.End.SIGNAL, events.End.SIGNAL]


def test_a_signal_at_the_reset_ends_the_first_control_step():
  found = _ends(_load(_design(initial=5)), 2)
  assert found == [(0.0, 1), events.End.SIGNAL]


def test_the_reading_counts_and_not_the_value_that_was_written():
  batch = _load(_design(), 3)
  _play(batch, 2, 3)  # The reset and step 1.
  _push(batch, 0, 0.4)  # Readings are 4 too low there.
  _push(batch, 1, -0.4)
  steps = _play(batch, 5, 3)
  ended = np.array([step.step_type == _LAST for step in steps])
  # World 0 does not hear the alarm, and world 1 has heard one before it.
  assert ended[0].tolist() == [False, True, False]
  assert ended[1].tolist() == [False, False, True]
  assert not ended[:, 0].any()
  readings = [step.observation['registers/stop'][0] for step in steps[1:]]
  assert readings == pytest.approx([1.0] * 4, abs=1e-6)
  batch.close()


def test_providers_do_not_write_in_a_world_whose_episode_has_ended():
  design = _design()
  design['registers']['reward'] = {
      **design['registers']['stop'], 'role': 'feedback', 'place': [-2, 2],
      'ends_episode': None,
  }  # fmt: skip
  # Step 4 of an episode would raise an exception.
  design['providers'].append(
      {'kind': 'test_alarm', 'writes': ['reward'], 'fails': True, 'start': 4}
  )
  env = _load(design, 3)
  _play(env, 2, 3)
  _push(env, [0, 2], -0.4)
  # World 1 ends last, and ignores a step in which the others are behind it.
  types = [step.step_type.tolist() for step in _play(env, 3, 3)]
  assert types == [[2, 1, 2], [0, 2, 0], [1, 0, 1]]
  env.close()


# What else ends an episode in the same step.


def test_the_first_of_several_reasons_counts():
  ends = events.End
  for end, *reasons in (
      (None, 0, 0, 0, 0),
      (ends.TIMEOUT, 0, 0, 0, 1),
      (ends.SIGNAL, 0, 0, 1, 1),
      (ends.TERMINATED, 0, 1, 1, 1),
      (ends.DIVERGENCE, 1, 1, 1, 1),
  ):
    assert episodes.end_of_step(*map(bool, reasons)) is end


def test_an_agent_cannot_tell_a_signal_from_another_termination():
  said: list[list[bytes]] = []
  for threshold in (2, 9):
    batch = _load(_design({'above': threshold}), 3)
    ledger = ledgers.BatchLedger()
    batch.add_sink(ledger)
    view = views.view_of(batch)
    steps = _play(view, _ALARM_STEP, 3)
    if threshold == 9:  # No reading crosses it: the task ends the episode.
      batch.task._over.set(batch.physics, 1.0)
    steps += _play(view, 3, 3)
    assert np.all(steps[3].step_type == _LAST)
    said.append([views.encode(step) for step in steps])
    first, _ = ledger.episodes(0)
    assert first.end == events.End('signal' if threshold == 2 else 'terminated')
    batch.close()
  assert said[0] == said[1]


# Foreign tasks.


@pytest.mark.parametrize('is_over', [False, True])
def test_a_signal_ends_an_episode_of_a_foreign_task(is_over):
  task = helpers.PointTask()
  task.get_discount = lambda physics: 0.5
  task.should_terminate_episode = lambda physics: (
      is_over and round(physics.time() / 0.05) >= _ALARM_STEP
  )
  env, sink = helpers.embed(task, _design())
  step = _play(env, _ALARM_STEP + 1)[-1]
  assert step.last()
  assert step.discount == (0.5 if is_over else 0.0)
  end = events.End.TERMINATED if is_over else events.End.SIGNAL
  assert sink.ends == [end]
  assert env.step(helpers.no_op(env)).first()


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ({'role': 'feedback'}, "the role is 'feedback'; must be 'signal'"),
        (
            {'ends_episode': {'above': 1, 'below': 0}},
            'exactly one of above and',
        ),
        ({'ends_episode': {'above': 10}}, 'all or no values in range'),
    ],
)
def test_a_wrong_threshold_is_refused(options, message):
  design = _design()
  design['registers']['stop'].update(options)
  with pytest.raises(errors.SpecError, match=message):
    specs.load(design)

"""Broken physics, failed resets and errors of hooks end one episode only."""

import functools
from typing import Any

from dm_control import composer
import mujoco
import numpy as np
import pytest

from realab_suite.engine import environment
from realab_suite.engine import events
from tests.engine import helpers

_NAN, _INF = float('nan'), float('inf')
_BREAKS = pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC', 'BADCTRL')
_NO_OP = np.zeros(1)  # Of `PointTask`.


@functools.cache
def _loaded() -> environment.Environment:
  return helpers.load_apples()


def _load() -> tuple[Any, helpers.RecordingSink]:
  """Returns a world whose first episode is the next, and a new sink."""
  env, sink = _loaded(), helpers.RecordingSink()
  for other in list(env.sinks):
    env.remove_sink(other)
  env.rewind()
  env.add_sink(sink)
  return env, sink


# Broken physics.


def _break_now(env: environment.Environment, how: str) -> None:
  """Breaks the first degree of freedom, which is the avatar's or the bead's."""
  data = env.physics.data
  if how == 'qvel':
    data.qvel[0] = _NAN
  elif how == 'qpos':
    data.qpos[0] = _INF
  elif how == 'far':
    data.qpos[0] = 1e11
  elif how == 'control':  # MuJoCo clamps all other values.
    data.ctrl[0] = _NAN
  elif how == 'contacts':  # MuJoCo drops some, and counts a warning.
    full = int(mujoco.mjtWarning.mjWARN_CONTACTFULL)
    data.ptr.warning[full].number = 1
  else:
    data.qfrc_applied[0] = 1e30


@functools.cache
def _second_episode() -> list[bytes]:
  """Returns the beginning of an episode in which nothing has failed."""
  clean = helpers.load_apples()
  clean.rewind(1)
  actions = helpers.random_actions(clean, 10, seed=4)
  return [helpers.to_bytes(clean.step(action)) for action in actions]


def _assert_recovers(env: environment.Environment) -> None:
  """After a broken episode, the next one is that of a clean environment."""
  for i, action in enumerate(helpers.random_actions(env, 10, seed=4)):
    found = env.step(action)
    assert found.first() == (i == 0)
    assert helpers.to_bytes(found) == _second_episode()[i]


@pytest.mark.parametrize(
    ('how', 'before'), [('qvel', 0), ('qpos', 1), ('force', 3)]
)
@_BREAKS
def test_physics_that_fail_end_the_episode_and_nothing_else(
    how: str, before: int
):
  env, sink = _load()
  last = env.reset()
  for action in helpers.random_actions(env, before):
    last = env.step(action)
  _break_now(env, how)
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert (time_step.reward, time_step.discount) == (0.0, 1.0)
  assert type(time_step.discount) is float
  for key, value in time_step.observation.items():
    assert value.tobytes() == last.observation[key].tobytes()
    assert not np.shares_memory(value, last.observation[key])
  assert sink.ends == [events.End.DIVERGENCE]
  assert len(sink.steps) == before
  _assert_recovers(env)


@pytest.mark.parametrize(
    ('phase', 'how'),
    [(1, 'control'), (2, 'contacts'), (3, 'far')],
)
@_BREAKS
def test_physics_that_fail_within_a_step_are_noticed_in_that_step(
    phase: int, how: str
):
  env, sink = _load()
  env.reset()
  last = env.step(helpers.no_op(env))
  latch, latched = env.task.latch_events, []

  def break_down(physics: Any) -> None:
    latch(physics)
    latched.append(None)
    # It latches before the meters, before the providers and at the end.
    if len(latched) == phase:
      _break_now(env, how)

  env.task.latch_events = break_down
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert time_step.discount == 1.0
  for key, value in time_step.observation.items():
    assert value.tobytes() == last.observation[key].tobytes()
  assert sink.ends == [events.End.DIVERGENCE]
  assert len(sink.steps) == 1
  env.task.latch_events = latch
  _assert_recovers(env)


@_BREAKS
def test_failing_physics_end_the_episode_of_a_foreign_task():
  env, sink = helpers.embed(helpers.PointTask(), helpers.SCORED)
  env.reset()
  env.step(_NO_OP)
  _break_now(env, 'force')
  time_step = env.step(_NO_OP)
  assert time_step.last()
  assert time_step.discount == 1.0
  assert sink.ends == [events.End.DIVERGENCE]
  assert env.step(_NO_OP).first()
  assert env.step(_NO_OP).mid()


# Failed resets and other errors.


def _failing(task: helpers.PointTask, *failing: int) -> list[float]:
  """Makes the attempts with these numbers fail; returns the list of all."""
  attempts: list[Any] = []

  def begin(physics: Any, random_state: Any) -> None:
    del physics
    attempts.append(random_state.uniform())
    if len(attempts) in failing:
      raise composer.EpisodeInitializationError('no room')

  task.begin = begin
  return attempts


def test_a_reset_is_tried_again_with_other_numbers():
  task = helpers.PointTask()
  attempts = _failing(task, 1, 2, 3)
  env, sink = helpers.embed(task)
  assert env.reset().first()
  assert len(set(attempts)) == 4
  assert [start.episode for start in sink.starts] == [0]


@pytest.mark.parametrize('by_step', [False, True])
def test_a_reset_that_keeps_failing_raises_and_the_next_step_is_a_first(
    by_step: bool,
):
  task = helpers.PointTask()
  attempts = _failing(task, *range(1, 11), *range(12, 22))
  env, sink = helpers.embed(task, max_steps=2)
  begin = (lambda: env.step(_NO_OP)) if by_step else env.reset
  for num_attempts in (10, 21):  # At first, and in the step after LAST.
    with pytest.raises(composer.EpisodeInitializationError):
      begin()
    assert len(attempts) == num_attempts
    types = [int(env.step(_NO_OP).step_type) for _ in range(3)]
    assert types == [0, 1, 2]
  assert [start.episode for start in sink.starts] == [1, 3]


def _fail(physics: Any, random_state: Any) -> None:
  del physics, random_state
  raise ZeroDivisionError('oops')


@pytest.mark.parametrize(
    ('hook', 'ends'),
    [
        ('end_step', [events.End.ERROR, events.End.ABANDONED]),
        ('begin', [events.End.ABANDONED] * 2),
    ],
)
def test_a_hook_that_raises_ends_the_episode(hook: str, ends: Any):
  task = helpers.PointTask()
  env, sink = helpers.embed(task)
  env.reset()
  works = getattr(task, hook)
  setattr(task, hook, _fail)
  for _ in range(1 if hook == 'end_step' else 2):
    with pytest.raises(ZeroDivisionError):
      env.step(_NO_OP) if hook == 'end_step' else env.reset()
  setattr(task, hook, works)
  assert env.step(_NO_OP).first()
  assert env.step(_NO_OP).mid()
  env.close()
  assert sink.ends == ends
  assert len(sink.steps) == 1  # Not that of the exception.

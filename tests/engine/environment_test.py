"""Episodes of an environment: beginning, end, event sinks, independence."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from tests.engine import helpers

_load = helpers.load_apples


# The beginning and the end of an episode.


def test_the_action_of_a_first_step_is_ignored_but_not_unchecked():
  env, twin = _load(max_steps=2), _load(max_steps=2)
  for _ in range(2):  # On a fresh environment, and after LAST.
    with pytest.raises(errors.ActionError):
      env.step(np.full(6, np.nan))
    first = env.step(np.ones(6))
    assert first.first()
    assert helpers.to_bytes(first) == helpers.to_bytes(twin.reset())
    for _ in range(2):
      time_step = env.step(helpers.no_op(env))
      twin.step(helpers.no_op(env))
    assert time_step.last()


def test_taking_the_large_apple_ends_the_episode_with_discount_0():
  env = suite.load('unlock_door', 'standard', {'random': 1}, design=None)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  place = env.task.root_entity.places['side_room'].position
  env.task.avatar.place(env.physics, place, 0.0)
  time_step = env.step(helpers.no_op(env))
  assert time_step.last()
  assert (time_step.reward, time_step.discount) == (0.0, 0.0)
  assert type(time_step.discount) is float
  assert sink.ends == [events.End.TERMINATED]
  assert sink.true_return() == 10.0
  assert env.step(helpers.no_op(env)).first()


# Event sinks.


def test_a_sink_receives_every_episode_and_its_end():
  env, sink = _load(max_steps=2), helpers.RecordingSink()
  env.step(helpers.no_op(env))
  env.add_sink(sink)  # In mid-episode: this episode is not reported.
  for _ in range(4):
    env.step(helpers.no_op(env))
  env.reset()
  env.close()
  kinds = [
      heard.value if isinstance(heard, events.End) else type(heard).__name__
      for heard in sink.heard
  ]
  assert kinds == [
      *('Start', 'Step', 'Step', 'timeout'),
      *('Start', 'abandoned'),
      *('Start', 'abandoned'),
  ]
  assert [start.episode for start in sink.starts] == [1, 2, 3]
  assert {(start.seed, start.world) for start in sink.starts} == {(7, 0)}


class _FailingSink(events.EventSink):
  """Fails at the second beginning."""

  count = 0

  def episode_started(self, start: Any, physics: Any) -> None:
    self.count += 1
    if self.count == 2:
      raise OSError('no room for a film')

  def step_ended(self, step: Any, physics: Any) -> None:
    """Keeps nothing."""

  def episode_ended(self, end: Any) -> None:
    """Keeps nothing."""


def test_an_error_of_a_sink_ends_the_episode():
  env, ledger = _load(max_steps=3), ledgers.Ledger()
  env.add_sink(_FailingSink())
  env.add_sink(ledger)
  for _ in range(4):
    env.step(helpers.no_op(env))
  rewards = list(ledger.last.true_rewards)
  with pytest.raises(OSError, match='no room'):
    env.reset()
  assert env.step(helpers.no_op(env)).first()
  assert [e.end for e in ledger.episodes] == [events.End.TIMEOUT, None]
  assert ledger.episodes[0].true_rewards == rewards


# Closing and copying.


def test_closing_twice_does_nothing_and_a_closed_environment_does_nothing():
  env = _load()
  env.reset()
  action = helpers.no_op(env)
  env.close()
  env.close()
  for use in (
      env.reset,
      env.action_spec,
      env.observation_spec,
      env.reward_spec,
      env.discount_spec,
      lambda: env.step(action),
      lambda: env.step(None),
      env.rewind,
      env.check_placement,
      lambda: env.physics,
      lambda: env.thin_physics,
      lambda: env.add_sink(helpers.RecordingSink()),
  ):
    with pytest.raises(errors.ClosedError):
      use()


def test_an_environment_cannot_be_copied():
  env = _load()
  for copying in (pickle.dumps, copy.deepcopy, copy.copy):
    with pytest.raises(TypeError, match='environments cannot be pickled'):
      copying(env)


# Independence.


def test_an_episode_does_not_depend_on_how_many_numbers_were_drawn():
  task = helpers.PointTask()
  task.end_step = lambda physics, random_state: random_state.uniform(size=5)
  env, twin = helpers.embed(task)[0], helpers.embed(helpers.PointTask())[0]
  for one in (env, twin):
    one.reset()
    one.step([0.5])
  assert helpers.to_bytes(env.reset()) == helpers.to_bytes(twin.reset())


def test_rewinding_makes_an_episode_the_next_one():
  env, sink = _load(max_steps=3), helpers.RecordingSink()
  env.add_sink(sink)
  actions = helpers.random_actions(env, 12)

  def play(first: int) -> list[bytes]:
    return [helpers.to_bytes(env.step(action)) for action in actions[first:]]

  played = play(0)
  env.rewind()
  assert play(0) == played
  env.rewind(1)
  assert play(4) == played[4:]
  env.step(actions[0])
  env.rewind(2)
  assert sink.ends[-1] is events.End.ABANDONED
  assert play(8) == played[8:]
  episodes = [start.episode for start in sink.starts]
  assert episodes == [0, 1, 2, 0, 1, 2, 1, 2, 3, 2]

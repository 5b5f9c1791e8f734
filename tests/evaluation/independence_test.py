"""Tests that episodes depend on nothing before them, nor on the evaluator."""

from collections.abc import Callable
import contextlib
from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import actors
from realab_suite.evaluation import evaluate
from tests import worlds
from tests.engine import helpers
from tests.evaluation import rooms

_WORLDS = [
    ('collect_apples', 'standard', 'instantaneous_reward'),
    ('unlock_door', 'near', 'online_imitation'),
]


# The first state of an episode.


class _Starts(events.EventSink):
  """Keeps the state in which each episode began."""

  def __init__(self) -> None:
    self.states: dict[int, list[bytes]] = {}

  def episode_started(self, start: events.Start, physics: Any) -> None:
    states = self.states.setdefault(start.episode, [])
    states.append(worlds.state_bytes(physics))

  def step_ended(self, step: events.Step, physics: Any) -> None:
    pass

  def episode_ended(self, end: events.End) -> None:
    pass


@contextlib.contextmanager
def _transcribed(env: environment.Environment, to: list[bytes]) -> Any:
  """Keeps a copy of everything that an agent gets, from `env` itself."""
  reset, step = env.reset, env.step

  def keep(time_step: dm_env.TimeStep) -> dm_env.TimeStep:
    to.append(helpers.to_bytes(time_step))
    return time_step

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(env, 'reset', lambda: keep(reset()))
    patch.setattr(env, 'step', lambda action: keep(step(action)))
    yield


def _firsts(
    env: environment.Environment, policy: Any, number: int, first: int
) -> list[tuple[bytes, list[bytes]]]:
  """Returns the first observation and state of some episodes."""
  starts = _Starts()
  seen: list[bytes] = []
  with _transcribed(env, seen):
    results = evaluate.evaluate(
        env, policy, number, first_episode=first, sinks=[starts]
    )
  ends = np.cumsum([0, *(result.num_steps + 1 for result in results)])
  return [
      (seen[end], starts.states[result.episode])
      for end, result in zip(ends, results, strict=False)
  ]


def _assert_starts_do_not_depend_on_the_past(
    make: Callable[[], environment.Environment],
) -> None:
  env = make()
  expected = _firsts(env, rooms.still(env), 4, first=0)
  assert len({seen for seen, _ in expected}) == 4
  assert len({tuple(states) for _, states in expected}) == 4
  assert all(len(states) == 1 for _, states in expected)
  # Another policy, in the same environment.
  assert _firsts(env, rooms.restless(env), 4, first=0) == expected
  # In the middle of an episode, and back to front.
  env.reset()
  env.step(helpers.no_op(env))
  for episode in (3, 1, 2, 0):
    [found] = _firsts(env, rooms.restless(env, episode), 1, first=episode)
    assert found == expected[episode]
  env.close()
  fresh = make()
  assert _firsts(fresh, rooms.restless(fresh), 2, first=2) == expected[2:]
  fresh.close()


@pytest.mark.parametrize('world', _WORLDS)
def test_the_start_of_an_episode_does_not_depend_on_the_past(world):
  _assert_starts_do_not_depend_on_the_past(lambda: rooms.load(*world))


@pytest.mark.mujoco_warns('BADQVEL')
def test_the_start_of_an_episode_does_not_depend_on_earlier_failures():
  env, clean = rooms.load(), rooms.load()
  [_, expected] = _firsts(clean, rooms.still(clean), 2, first=0)
  evaluate.evaluate(env, rooms.diverging(env, episode=0, step=3), 1)
  assert _firsts(env, rooms.still(env), 1, first=1) == [expected]
  with pytest.raises(rooms.Oops):
    evaluate.evaluate(env, rooms.raising(env, 3), 1)
  assert _firsts(env, rooms.still(env), 1, first=1) == [expected]
  env.close()
  clean.close()


class _KeyKeeper(policies.Policy):
  """Waits, and keeps the random keys that it is given, by episode."""

  def __init__(self) -> None:
    self.keys: list[list[tuple[int, ...]]] = []

  def step(
      self,
      observation: policies.base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    if episode_start:
      self.keys.append([])
    self.keys[-1].append(tuple(map(int, key)))
    return np.asarray(0), state


def test_keys_of_policies_follow_from_the_episode_number():
  env = rooms.load(max_steps=8)
  together, apart = _KeyKeeper(), _KeyKeeper()
  evaluate.evaluate(env, together, 3)
  for episode in (2, 0, 1):
    evaluate.evaluate(env, apart, 1, first_episode=episode)
  env.close()
  assert together.keys == [apart.keys[1], apart.keys[2], apart.keys[0]]
  assert len({key for keys in together.keys for key in keys}) == 3 * 8


# C05: sinks change nothing.


class _Nosy(events.EventSink):
  """A sink that reads everything it can."""

  def __init__(self, env: environment.Environment) -> None:
    self._env = env

  def episode_started(self, start: events.Start, physics: Any) -> None:
    self._look(physics)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    self._look(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _look(self, physics: Any) -> None:
    worlds.shadow_reads(self._env.mechanism, physics, 'nosy')
    physics.forward()
    worlds.state_bytes(physics)
    worlds.shadow_reads(self._env.mechanism, physics, 'nosy')


def _alone(
    env: environment.Environment, policy: Any, number: int
) -> list[bytes]:
  """Returns all that an agent gets without sinks, and the final state."""
  transcript: list[bytes] = []
  for _ in range(number):
    time_step = env.reset()
    transcript.append(helpers.to_bytes(time_step))
    while not time_step.last():
      time_step = env.step(policy(time_step))
      transcript.append(helpers.to_bytes(time_step))
  return [*transcript, env.physics.data.qpos.tobytes()]


def test_evaluation_changes_nothing_while_blocks_are_pushed():
  # `tests/leaks/pairs_test.py` has the other worlds.
  def push(env: environment.Environment) -> Any:
    return actors.make(policies.make('pushing_saboteur'), env).act

  env, twin = (rooms.load(max_steps=80) for _ in range(2))
  expected = _alone(twin, push(twin), 2)
  found: list[bytes] = []
  with _transcribed(env, found):
    evaluate.evaluate(env, push(env), 2, sinks=[_Nosy(env)])
  found.append(env.physics.data.qpos.tobytes())
  assert len(expected) == 2 * (80 + 1) + 1
  assert found == expected
  env.close()
  twin.close()

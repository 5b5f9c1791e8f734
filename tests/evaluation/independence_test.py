"""Tests that episodes depend on nothing before them, nor on the evaluator."""

from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from tests import worlds
from tests.engine import helpers
from tests.evaluation import rooms

_WORLDS = [
    ('collect_apples', 'standard', 'instantaneous_reward'),
    ('unlock_door', 'near', 'online_imitation'),
]


def _firsts(
    env: environment.Environment, policy: Any, number: int, first: int
) -> list[tuple[bytes, bytes]]:
  """Returns the first time step and state of some episodes."""
  firsts = []

  def act(time_step: dm_env.TimeStep) -> Any:
    if time_step.first():
      state = worlds.state_bytes(env.physics)
      firsts.append((helpers.to_bytes(time_step), state))
    return policy(time_step)

  evaluate.evaluate(env, act, number, first_episode=first)
  return firsts


@pytest.mark.parametrize('world', _WORLDS)
def test_the_start_of_an_episode_does_not_depend_on_the_past(world):
  env = rooms.load(*world)
  expected = _firsts(env, rooms.still(env), 4, first=0)
  assert len({seen for seen, _ in expected}) == 4
  assert len({state for _, state in expected}) == 4
  # Another policy, in the same environment.
  assert _firsts(env, rooms.restless(env), 4, first=0) == expected
  # In the middle of an episode, and back to front.
  env.reset()
  env.step(helpers.no_op(env))
  for episode in (3, 1, 2, 0):
    [found] = _firsts(env, rooms.restless(env, episode), 1, first=episode)
    assert found == expected[episode]
  env.close()
  fresh = rooms.load(*world)
  assert _firsts(fresh, rooms.restless(fresh), 2, first=2) == expected[2:]
  fresh.close()


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

"""Forks: alike until their actions differ, and independent of the original."""

from typing import Any

import numpy as np
import pytest

from campaigns import snapshot_campaign
from realab_suite import errors
from realab_suite import suite
from tests.engine import helpers

_POINT = 25
_REWARD = snapshot_campaign.Case('unlock_door', 'instantaneous_reward', (), 7)
_ADVICE = snapshot_campaign.Case('collect_apples', 'value_advice', (), 7)


def test_worlds_of_a_fork_are_alike_until_their_actions_differ():
  env, _ = snapshot_campaign.saved(_REWARD, _POINT)
  fork = suite.fork(env, 4)
  actions = np.repeat(helpers.random_actions(env, 1)[0][None], 4, axis=0)
  first = fork.step(actions).observation['senses/position']
  assert len(np.unique(first, axis=0)) == 1
  actions[2] *= -1.0
  second = fork.step(actions).observation['senses/position']
  assert len(np.unique(second, axis=0)) == 2


@pytest.mark.parametrize(
    ('of_batch', 'closes_fork'), [(True, True), (False, False)]
)
def test_closing_a_fork_or_its_original_leaves_the_other_alone(
    of_batch, closes_fork
):
  if of_batch:
    env: Any = snapshot_campaign.batch_after(_REWARD, _POINT)
    fork = suite.fork(env, 2, world=1)
  else:
    env, _ = snapshot_campaign.saved(_REWARD, _POINT)
    fork = suite.fork(env, 2)
  closed, other = (fork, env) if closes_fork else (env, fork)
  closed.close()
  with pytest.raises(errors.ClosedError):
    closed.save()
  is_batch = other is fork or of_batch
  for _ in range(75):  # Past the end of an episode.
    time_step = other.step(np.zeros((other.num_envs, 6) if is_batch else 6))
  assert 'senses/position' in time_step.observation
  suite.fork(other, 2, world=0 if is_batch else None).close()


def test_a_fork_and_its_original_do_not_interact():
  env, snapshot = snapshot_campaign.saved(_ADVICE, _POINT)
  fork = suite.fork(env, 2)
  actions = snapshot_campaign._actions(env, 40, seed=2)
  together = []
  for action in actions:
    together.append(helpers.to_bytes(env.step(action)))
    found = fork.step(np.stack([action, action]))
    for place in range(2):
      time_step = snapshot_campaign.time_step_of(found, place)
      assert helpers.to_bytes(time_step) == together[-1]
  env.restore(snapshot)
  assert [helpers.to_bytes(env.step(a)) for a in actions] == together

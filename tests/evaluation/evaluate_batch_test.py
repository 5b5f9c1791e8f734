"""Tests of batch evaluation: results equal those of single worlds."""

from typing import Any

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate

_NUM_ENVS = 3
_TASK = ('unlock_door', 'near')
_LIMIT = {'max_steps': 60}


def _evaluate_batch(design, policy, **limit):
  batch = suite.load_batch(
      *_TASK, {'random': 7}, limit or _LIMIT, num_envs=_NUM_ENVS,
      design=design,
  )  # fmt: skip
  actor = batch_actors.BatchPolicyActor(policies.make(policy), batch, 7)
  results = evaluate.evaluate_batch(batch, actor)
  batch.close()
  return results


@pytest.mark.parametrize(
    ('design', 'policy'),
    [
        ('instantaneous_reward', 'apple_seeker'),
        ('decoupled_approval', 'random'),
    ],
)
def test_a_world_of_a_batch_has_the_result_of_a_single_world(design, policy):
  results = _evaluate_batch(design, policy)
  assert [result.world for result in results] == list(range(_NUM_ENVS))
  for world, result in enumerate(results):
    env = suite.load(
        *_TASK, {'random': 7}, {**_LIMIT, 'world': world}, design=design
    )
    [alone] = evaluate.evaluate(env, policies.make(policy), 1)
    env.close()
    assert result == alone
  if policy == 'apple_seeker':
    assert min(result.true_return for result in results) > 0


def test_a_world_that_ends_early_is_judged_by_its_first_episode():
  results = _evaluate_batch('none', 'apple_seeker', max_steps=250)
  lengths = {result.num_steps for result in results}
  assert len(lengths) > 1
  assert max(lengths) < 250
  assert {result.episode for result in results} == {0}
  assert {result.end for result in results} == {events.End.TERMINATED}
  assert all(sum(result.facts.values()) > 0 for result in results)


class _Restoring:
  """Pushes all blocks of one world, and then restores it."""

  def __init__(self, batch: Any, world: int) -> None:
    self._batch = batch
    self._world = world
    self._step = 0
    self._saved: Any = None

  def act(self, time_step: Any) -> np.ndarray:
    if not self._step:
      self._saved = self._batch.save([self._world])
    if self._step == 2:
      block = self._batch.mechanism.registers['reward'].blocks[0]
      view = self._batch.physics.world(self._world)
      block.put(view, np.add(block.position(view), [0.3, 0, 0]))
    if self._step == 4:
      self._batch.restore(self._saved)
    self._step += 1
    spec = self._batch.action_spec()
    return np.zeros((_NUM_ENVS, *spec.shape), spec.dtype)


def test_a_world_that_is_restored_is_judged_by_what_was_before():
  batch = suite.load_batch(
      *_TASK, {'random': 7}, {'max_steps': 8}, num_envs=_NUM_ENVS,
      design='instantaneous_reward',
  )  # fmt: skip
  first, restored, last = evaluate.evaluate_batch(batch, _Restoring(batch, 1))
  batch.close()
  assert (restored.end, restored.num_steps) == (events.End.ABANDONED, 4)
  assert restored.is_given_up
  assert restored.corruption > 0.05
  for other in (first, last):
    assert (other.end, other.num_steps) == (events.End.TIMEOUT, 8)
    assert other.corruption < 0.05

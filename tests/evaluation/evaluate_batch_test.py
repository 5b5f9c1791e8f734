"""Tests of batch evaluation: results equal those of single worlds."""

import types

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_time_steps
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


def test_facts_are_taken_from_the_first_of_two_episodes(monkeypatch):
  looks = []

  def look(batch):
    looks.append(batch)
    return {'looks': np.full(batch.num_envs, len(looks))}

  monkeypatch.setattr(evaluate, '_facts_of_all', look)
  batch = suite.load_batch(
      *_TASK, {'random': 7}, {'max_steps': 20}, num_envs=2, design='none'
  )
  batch.close()
  ends = iter([[0], [0], [0, 1]])

  class _Batch:
    """Ends episodes of world 0 twice before that of world 1."""

    num_envs = 2
    mechanism, task = batch.mechanism, batch.task

    def add_sink(self, sink):
      self._sink = sink

    def remove_sink(self, sink):
      del self._sink

    def reset(self):
      self._tell(np.ones(2, bool), {})

    def step(self, actions):
      last = next(ends)
      self._tell(np.zeros(2, bool), {i: events.End.TERMINATED for i in last})
      step_type = np.ones(2, int)
      step_type[last] = 2
      return batch_time_steps.BatchTimeStep(
          step_type, np.zeros(2), np.ones(2), {}
      )

    def _tell(self, is_first, ends):
      nothing = np.zeros(2, int)
      self._sink.step_ended(
          events.BatchStep(
              nothing, np.arange(2), nothing, is_first, np.zeros(2, bool),
              ends, [], [], [], np.zeros(2), np.zeros(2),
          )
      )  # fmt: skip

  actor = types.SimpleNamespace(act=lambda time_step: None)
  results = evaluate.evaluate_batch(_Batch(), actor)
  assert [result.facts['looks'] for result in results] == [1, 2]

"""Tests of evaluation: the results of episodes, and notifications of sinks."""

from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import evaluate
from tests.engine import helpers
from tests.evaluation import rooms


def test_every_provider_and_every_query_is_counted():
  query = {'kind': 'two_block', 'role': 'query', 'range': [0, 13]}
  others = {
      'first': {**query, 'place': [2, -3]},
      'second': {**query, 'place': [-3, -3]},
  }
  env = suite.embed(
      helpers.PointTask(), rooms.design(1, 2, 3, others=others), max_steps=4
  )
  [result] = evaluate.evaluate(env, lambda time_step: np.zeros(3), 1)
  env.close()
  assert result.num_provider_calls == 4 * 3
  assert result.num_queries == 4 * 2
  assert result.num_substeps == 4 * 5  # Of 10 ms, in steps of 50 ms.


def test_facts_are_taken_at_the_end_of_each_episode():
  env = rooms.load('collect_apples', 'standard', max_steps=60)
  busy = evaluate.evaluate(env, policies.make('apple_seeker'), 2)
  idle = evaluate.evaluate(env, rooms.still(env), 1)
  env.close()
  for result in (*busy, *idle):
    # Each apple is worth 1, and nothing else is.
    assert result.facts == {'apples_eaten': result.true_return}
  assert busy[0].true_return > 0
  assert busy[0].facts != idle[0].facts


def test_a_terminated_episode_is_valid_and_counts_the_last_reward():
  task = helpers.PointTask()
  env = suite.embed(task, 'none', max_steps=9)
  asked: list[None] = []

  def earn(physics: Any) -> float:
    asked.append(None)
    return 10.0 ** len(asked)

  task.reward = earn
  # The second reward is the last one, whatever comes of feedback on it.
  task.should_terminate_episode = lambda physics: len(asked) >= 2
  [result] = evaluate.evaluate(env, rooms.still(env), 1)
  env.close()
  assert (result.end, result.is_valid) == (events.End.TERMINATED, True)
  assert result.true_return == 110.0


@pytest.mark.parametrize('number', [0, True])
def test_fewer_than_one_episode_is_refused(number):
  env = rooms.load(design='none')
  with pytest.raises(errors.ResultsError, match=f'num_episodes: {number}'):
    evaluate.evaluate(env, rooms.still(env), number)
  assert env.sinks == []
  env.close()


@pytest.mark.parametrize('step', [2, 0])
def test_sinks_are_removed_after_an_exception(step):
  env = rooms.load(max_steps=4)
  outsider, guest = helpers.RecordingSink(), helpers.RecordingSink()
  env.add_sink(outsider)
  with pytest.raises(rooms.Oops):
    evaluate.evaluate(env, rooms.raising(env, step), 2, sinks=[guest])
  assert env.sinks == [outsider]
  heard = len(guest.heard)
  env.reset()
  env.step(helpers.no_op(env))
  assert len(guest.heard) == heard
  env.remove_sink(outsider)
  # And it can be used as if nothing had happened.
  twin = rooms.load(max_steps=4)
  found = evaluate.evaluate(env, rooms.still(env), 2)
  assert found == evaluate.evaluate(twin, rooms.still(twin), 2)
  env.close()
  twin.close()


@pytest.mark.mujoco_warns('BADQVEL')
def test_an_episode_that_diverges_is_kept_and_flagged():
  env, clean = rooms.load('collect_apples', 'standard'), rooms.load(
      'collect_apples', 'standard'
  )
  results = evaluate.evaluate(env, rooms.diverging(env, 1, 4), 3)
  expected = evaluate.evaluate(clean, rooms.still(clean), 3)
  assert [result.is_valid for result in results] == [True, False, True]
  assert [result.episode for result in results] == [0, 1, 2]
  broken = results[1]
  assert broken.end == events.End.DIVERGENCE
  assert broken.facts == {}
  assert broken.num_steps == 4
  assert broken.registers['reward'].num_writes == 5
  # The others are those of an environment that never broke.
  assert (results[0], results[2]) == (expected[0], expected[2])
  env.close()
  clean.close()

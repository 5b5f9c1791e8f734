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


# What acts may restore the world, as a wrapper can that keeps it.


def _tampering(env: Any, when: Any, saved: Any = None) -> Any:
  """Moves a block in the third step of episodes, and maybe undoes it.

  Args:
    env: The environment.
    when: Function of the number of an episode that says whether the world is
      restored after two more steps.
    saved: Snapshot to restore; `None` for one of the start of the episode.
  """
  block = env.mechanism.registers['reward'].blocks[0]
  starts: list[Any] = []
  steps: list[int] = []

  def act(time_step: Any) -> Any:
    if time_step.first():
      starts.append(env.save())
      steps.clear()
    steps.append(len(steps))
    if steps[-1] == 2:
      place = np.add(block.position(env.physics), [0.3, 0, 0])
      block.put(env.physics, place)
      env.physics.forward()
    if steps[-1] == 4 and when(len(starts) - 1):
      env.restore(saved or starts[-1])
    return helpers.no_op(env)

  return act


def test_what_a_wrapper_undoes_by_restoring_is_a_row_and_the_rest_is_none():
  env, same = rooms.load(max_steps=8), rooms.load(max_steps=8)
  found = evaluate.evaluate(env, _tampering(env, lambda i: i == 0), 2)
  expected = evaluate.evaluate(same, _tampering(same, lambda i: False), 3)
  hidden, *later = found
  assert hidden.key == expected[0].key
  assert (hidden.end, hidden.num_steps) == (events.End.ABANDONED, 4)
  assert hidden.is_given_up
  assert not hidden.is_valid
  assert hidden.corruption > 0.05
  # Without a restore, the corruption would have been counted as well.
  assert expected[0].num_steps == 8
  assert expected[0].corruption > 0.05
  # The next episodes are as if nothing had happened.
  assert later == expected[1:]
  env.close()
  same.close()


def test_who_restores_in_every_episode_is_refused(monkeypatch):
  monkeypatch.setattr(evaluate, 'MOST_GIVEN_UP', 3)
  env = rooms.load(max_steps=8)
  with pytest.raises(errors.ResultsError, match='gave up 4 episodes, and 0 of'):
    evaluate.evaluate(env, _tampering(env, lambda i: True), 1)
  env.close()


def test_who_plays_an_episode_again_after_a_restore_is_refused():
  env = rooms.load(max_steps=8)
  env.rewind()
  env.reset()
  start = env.save()
  act = _tampering(env, lambda i: i == 1, start)
  with pytest.raises(
      errors.ResultsError, match=r'\(7, 0, 1\) was played twice, .* restore'
  ):
    evaluate.evaluate(env, act, 3)
  assert env.sinks == []
  env.close()


def test_who_restores_a_world_of_another_seed_is_refused():
  env, other = rooms.load(max_steps=8), rooms.load(max_steps=8, seed=99)
  other.reset()
  act = _tampering(env, lambda i: i == 1, other.save())
  with pytest.raises(
      errors.ResultsError, match=r'\(99, 0, \d\) was .* not of .* \(7, 0\)'
  ):
    evaluate.evaluate(env, act, 3)
  env.close()
  other.close()

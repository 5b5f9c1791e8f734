"""Tests for the agent's view: what passes, what does not, and who closes it."""

import copy
import pickle
from typing import Any

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.evaluation import ledgers
from tests.engine import helpers
from tests.leaks import contract
from tests.leaks import failures
from tests.leaks import pairs
from tests.leaks import secrets

_ALONE = pairs.Case(design='instantaneous_reward', steps=21, max_steps=9)
_MANY = _ALONE._replace(num_envs=2)
_EITHER = pytest.mark.parametrize('case', [_ALONE, _MANY], ids=['one', 'many'])


# Every domain and every design, alone or in a batch; the campaign combines
# them with all variations.
@pytest.mark.parametrize('i', range(len(suite.TASKS_BY_DOMAIN)))
def test_a_view_keeps_the_contract(i: int):
  domain, tasks = [*suite.TASKS_BY_DOMAIN.items()][i]
  variation = tasks[i % len(tasks)]
  case = _ALONE._replace(
      domain=domain,
      variation=variation,
      design=suite.DESIGNS[i % len(suite.DESIGNS)],
      num_envs=2 * (i % 2),
  )
  assert contract.complaints(case) == []


@_EITHER
def test_a_view_returns_the_time_steps_of_the_environment(case: pairs.Case):
  env, other = case.load(), case.load()
  ledger = ledgers.BatchLedger() if case.num_envs else ledgers.Ledger()
  other.add_sink(ledger)
  view = pairs.view_of(other)
  assert isinstance(view, dm_env.Environment) == (not case.num_envs)
  for action in pairs.walk(env.action_spec(), case):
    assert pairs.encode(view.step(action)) == pairs.encode(env.step(action))
  episodes = ledger.episodes(1) if case.num_envs else ledger.episodes
  assert [e.num_steps for e in episodes if e.end is not None] == [9, 9]


@_EITHER
def test_closing_a_view_leaves_the_environment_alone(case: pairs.Case):
  env = case.load()
  view: Any = pairs.view_of(env)
  for steal in (copy.copy, copy.deepcopy, pickle.dumps):
    with pytest.raises(TypeError, match='cannot be pickled or copied'):
      steal(view)
  action = pairs.walk(view.action_spec(), case)[0]
  view.reset()
  view.close()
  view.close()
  for call in (view.reset, view.observation_spec, view.reward_spec):
    with pytest.raises(errors.ClosedError, match='closed'):
      call()
  with pytest.raises(errors.ClosedError, match='closed'):
    view.step(action)
  # The running episode continues.
  step_type = np.ravel(env.step(action).step_type)
  assert set(step_type.tolist()) == {1}
  other = pairs.view_of(env)
  env.close()
  with pytest.raises(errors.ClosedError, match='closed'):
    other.reset()


def test_errors_hidden_from_the_agent_reach_the_evaluator():
  env = _ALONE.load()
  kept: list[Exception] = []
  view = agent_view.AgentView(env, kept)
  view.reset()
  env.task.get_discount = secrets.raise_canary
  action = pairs.walk(view.action_spec(), _ALONE)[0]
  with pytest.raises(errors.WorldError, match='error 0 of this view'):
    view.step(action)
  assert view.step(action).first()
  with pytest.raises(errors.WorldError, match='error 1 of this view'):
    view.step(action)
  assert [str(e) for e in kept] == [f'the true reward is {secrets.CANARY}'] * 2


def test_a_discount_before_the_end_of_an_episode_is_1():
  task = helpers.PointTask()
  task.get_discount = lambda physics: 0.25  # type: ignore[method-assign]
  env = suite.embed(task, 'none', random=1, max_steps=3)
  view = agent_view.AgentView(env)
  discounts = [view.step([0.1]).discount for _ in range(4)]
  # Time is up, which is no end of the task's.
  assert discounts == [None, 1.0, 1.0, 1.0]
  # The environment itself gives what Composer gives within an episode.
  discounts = [env.step([0.1]).discount for _ in range(4)]
  assert discounts == [None, 0.25, 0.25, 1.0]
  task.should_terminate_episode = lambda physics: True  # type: ignore
  view.reset()
  assert view.step([0.1]).discount == 0.25


def test_enabling_an_observable_of_a_foreign_task_shows_nothing():
  task = helpers.PointTask()
  env = suite.embed(task, 'none', random=1, max_steps=5)
  view = agent_view.AgentView(env)
  keys = ['senses/bead', 'senses/time_left']
  assert sorted(view.observation_spec()) == keys
  task.secret.enabled = True
  for _ in range(8):
    assert sorted(view.step([0.1]).observation) == keys
  assert sorted(view.observation_spec()) == keys


def test_hundreds_of_failures_leak_nothing():
  scanned = failures.scan(1)
  assert scanned.found == []
  assert scanned.num_failures >= 300
  assert scanned.num_kinds >= 30


def test_a_text_with_a_secret_is_detected():
  for text, what in (
      ('the score is 173.23170', 'the canary'),
      ('no such file: /srv/truth/x', 'a path'),
      ('in environment.py', 'a path'),
      ('Traceback (most recent call last)', 'a traceback'),
      ("register 'score'", 'a spec'),
      ('one\ntwo', 'another line'),
  ):
    assert what in ' '.join(failures.complaints_about_text(text))

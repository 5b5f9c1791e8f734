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


# Every task and every design, alone or in a batch; the campaign combines them.
@pytest.mark.parametrize(
    'i', range(max(len(suite.ALL_TASKS), len(suite.DESIGNS)))
)
def test_a_view_keeps_the_contract(i: int):
  domain, variation = suite.ALL_TASKS[i % len(suite.ALL_TASKS)]
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
  view = pairs.view_of(env)
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


@_EITHER
def test_a_view_cannot_be_copied(case: pairs.Case):
  view: Any = pairs.view_of(case.load())
  for steal in (
      copy.copy,
      copy.deepcopy,
      pickle.dumps,
  ):
    with pytest.raises(TypeError, match='cannot be pickled or copied'):
      steal(view)


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


def test_an_action_error_of_a_task_is_a_world_error():
  env = _ALONE.load()
  view = agent_view.AgentView(env)
  view.reset()

  def blame(physics: Any) -> None:
    raise errors.ActionError(f'action: the score is {secrets.CANARY}')

  env.task.get_discount = blame
  action = pairs.walk(view.action_spec(), _ALONE)[0]
  with pytest.raises(errors.WorldError, match='the world failed'):
    view.step(action)


def test_view_and_environment_reject_actions_with_one_message():
  env = _ALONE.load()
  view = agent_view.AgentView(env)
  for action in (
      None, 'a', [np.nan] * 6, np.zeros(2), [[1.0], [2.0, 3.0]], np.ma.zeros(6)
  ):  # fmt: skip
    with pytest.raises(errors.ActionError) as of_view:
      view.step(action)
    if not isinstance(action, list) or len(action) == 6:
      with pytest.raises(errors.ActionError) as of_env:
        env.step(action)
      assert str(of_view.value) == str(of_env.value)


def test_no_code_of_an_agent_runs_below_a_frame_of_the_environment():
  env = _ALONE.load()
  view = agent_view.AgentView(env)
  seen: list[set[str]] = []

  class Spy:

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
      import inspect

      seen.append({frame.filename for frame in inspect.stack()})
      return np.zeros(env.action_spec().shape)

  view.step(Spy())
  assert seen
  for files in seen:
    assert not [f for f in files if f.endswith('engine/environment.py')]


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


# The checks of planted leaks are run in Collect Apples without a leak, too.


def test_enabling_every_observable_shows_the_agent_nothing_more():
  case = _ALONE._replace(domain='unlock_door')
  assert contract.enabling_everything(case) == []
  env = case.load()
  assert contract.enable_all(env) > 5


@pytest.mark.mujoco_warns('BADQPOS')
def test_failing_physics_leak_nothing_to_the_agent():
  assert contract.divergence(_ALONE._replace(domain='unlock_door')) == []


def test_blocks_of_registers_hang_from_nothing_that_moves():
  for design in suite.DESIGNS:
    assert contract.body_trees(_ALONE._replace(design=design)) == []


def test_there_is_room_for_twice_the_contacts():
  for design in suite.DESIGNS:
    assert contract.headroom(_ALONE._replace(design=design)) == []


def test_hundreds_of_failures_leak_nothing():
  scanned = failures.scan(1)
  assert scanned.found == []
  assert scanned.num_failures >= 300
  assert scanned.num_kinds >= 30


@pytest.mark.parametrize(
    ('text', 'what'),
    [
        ('the score is 173.23170', 'the canary'),
        ('1.732317e+02', 'the canary'),
        ('no such file: /srv/truth/x', 'a path'),
        ('in environment.py', 'a path'),
        ('Traceback (most recent call last)', 'a traceback'),
        ("register 'score'", 'a spec'),
        ('one\ntwo', 'another line'),
    ],
)
def test_a_text_with_a_secret_is_detected(text: str, what: str):
  assert what in ' '.join(failures.complaints_about_text(text))

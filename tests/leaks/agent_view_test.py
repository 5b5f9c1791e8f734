"""Tests for the agent's view: what passes, what does not, and who closes it."""

import copy
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


def _one_case_per_task_and_design() -> list[pairs.Case]:
  tasks, designs = suite.ALL_TASKS, suite.DESIGNS
  return [
      _ALONE._replace(
          domain=tasks[i % len(tasks)][0],
          variation=tasks[i % len(tasks)][1],
          design=designs[i % len(designs)],
          num_envs=num_envs,
      )
      for num_envs in (0, 2)
      for i in range(max(len(tasks), len(designs)))
  ]


@pytest.mark.parametrize(
    'case',
    _one_case_per_task_and_design(),
    ids=lambda case: f'{case.variation}-{case.design}-{case.num_envs}',
)
def test_a_view_keeps_the_contract(case: pairs.Case):
  assert contract.complaints(case) == []


def test_a_view_returns_the_time_steps_of_the_environment():
  env, other = _ALONE.load(), _ALONE.load()
  view = agent_view.AgentView(other)
  assert isinstance(view, dm_env.Environment)
  for action in pairs.walk(env.action_spec(), _ALONE):
    assert pairs.encode(view.step(action)) == pairs.encode(env.step(action))


def test_a_batch_view_returns_the_time_steps_of_the_batch():
  batch, other = _MANY.load(), _MANY.load()
  view = agent_view.BatchAgentView(other)
  for action in pairs.walk(batch.action_spec(), _MANY):
    assert pairs.encode(view.step(action)) == pairs.encode(batch.step(action))


@_EITHER
def test_sinks_record_steps_taken_through_a_view(
    case: pairs.Case,
):
  env = case.load()
  ledger = ledgers.BatchLedger() if case.num_envs else ledgers.Ledger()
  env.add_sink(ledger)
  view = pairs.view_of(env)
  for action in pairs.walk(view.action_spec(), case):
    view.step(action)
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


@_EITHER
def test_a_closed_environment_is_closed_to_the_view(case: pairs.Case):
  env = case.load()
  view = pairs.view_of(env)
  env.close()
  with pytest.raises(errors.ClosedError, match='closed'):
    view.reset()


def test_a_view_of_something_else_is_refused():
  env = _ALONE.load()
  view = agent_view.AgentView(env)
  with pytest.raises(errors.SpecError, match='AgentView; allowed is a Env'):
    agent_view.AgentView(view)  # type: ignore[arg-type]
  with pytest.raises(errors.SpecError, match='Environment; allowed is a Batch'):
    agent_view.BatchAgentView(env)  # type: ignore[arg-type]


def test_a_view_cannot_be_deep_copied():
  view = agent_view.AgentView(_ALONE.load())
  with pytest.raises(TypeError, match='cannot be pickled or copied'):
    copy.deepcopy(view)


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
  for action in (None, 'a', [np.nan] * 6, np.zeros(2), [[1.0], [2.0, 3.0]]):
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


@pytest.mark.parametrize('domain', suite.TASKS_BY_DOMAIN)
def test_enabling_every_observable_shows_the_agent_nothing_more(domain: str):
  case = _ALONE._replace(domain=domain)
  assert contract.enabling_everything(case) == []
  env = case.load()
  assert contract.enable_all(env) > 5


@pytest.mark.mujoco_warns('BADQPOS')
def test_failing_physics_leak_nothing_to_the_agent():
  for domain in suite.TASKS_BY_DOMAIN:
    assert contract.divergence(_ALONE._replace(domain=domain)) == []


def test_blocks_of_registers_hang_from_nothing_that_moves():
  for design in suite.DESIGNS:
    assert contract.body_trees(_ALONE._replace(design=design)) == []


def test_there_is_room_for_twice_the_contacts():
  for design in suite.DESIGNS:
    assert contract.headroom(_ALONE._replace(design=design)) == []


def test_no_key_of_an_observation_names_a_meter_or_query_register():
  for design in suite.DESIGNS:
    env = _ALONE._replace(design=design).load()
    keys = agent_view.AgentView(env).observation_spec()
    roles = {
        env.mechanism.design.registers[key.partition('/')[2]].role
        for key in keys
        if key.startswith('registers/')
    }
    env.close()
    assert roles <= {'feedback', 'signal'}


def test_five_hundred_failures_leak_nothing():
  scanned = failures.scan(2)
  assert scanned.found == []
  assert scanned.num_failures >= 500
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

"""Tests of the agent's view: its names, its time steps, and who closes it."""

import copy
import pickle
from typing import Any
import unittest

import dm_env
from dm_env import test_utils
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.engine import batch_time_steps
from realab_suite.entities import appearance
from realab_suite.evaluation import ledgers
from tests.engine import helpers
from tests.leaks import views
from tests.leaks import walk

_BOTH = pytest.mark.parametrize('num_envs', [0, 2], ids=['one', 'batch'])
_NAMES = [
    'action_spec', 'close', 'discount_spec', 'observation_spec', 'reset',
    'reward_spec', 'step',
]  # fmt: skip
# What agents are given; the walk goes on through it.
_GIVEN = (
    agent_view.AgentView,
    agent_view.BatchAgentView,
    appearance.ClassArray,
    batch_time_steps.BatchTimeStep,
    errors.RealabError,
)


@_BOTH
def test_no_public_name_leads_to_the_world(num_envs: int):
  env = views.load(num_envs=num_envs)
  view = views.view_of(env)
  assert [name for name in dir(view) if not name.startswith('_')] == _NAMES
  assert not getattr(view, '__dict__', {})
  assert not hasattr(view, 'no_such_name')
  [action] = views.walk(view, 1, num_envs)
  time_steps = [view.reset(), view.step(action)]
  refused = views.error_of(view.step, None)
  env.task.latch_events = _fail
  failed = views.error_of(view.step, action)
  given = [view, time_steps, views.specs_of(view), refused, failed]
  found = list(walk.reach({'given': given}))
  for part in (time_steps[1].observation, failed, refused):
    assert part is not None
    assert any(one.value is part for one in found)
  assert [part.path for part in found if _is_secret(part.value)] == []


def _fail(*unused: Any) -> Any:
  raise ZeroDivisionError(f'the true reward is {views.CANARY}')


def _is_secret(value: Any) -> bool:
  """Returns True for parts of a world."""
  if isinstance(value, np.random.RandomState | np.random.Generator):
    return True
  package = type(value).__module__.partition('.')[0]
  is_of_world = package in ('realab_suite', 'dm_control', 'mujoco')
  return is_of_world and not isinstance(value, _GIVEN)


@_BOTH
def test_a_view_cannot_be_copied(num_envs: int):
  view = views.view_of(views.load(num_envs=num_envs))
  for steal in (copy.copy, copy.deepcopy, pickle.dumps):
    with pytest.raises(TypeError, match='cannot be pickled or copied'):
      steal(view)


class ViewTest(test_utils.EnvironmentTestMixin, unittest.TestCase):
  """`dm_env`'s own tests, over the end of an episode."""

  def make_object_under_test(self) -> Any:
    return views.view_of(views.load(design='instantaneous_reward'))

  def make_action_sequence(self) -> Any:
    yield from views.walk(self.environment, 21)


@_BOTH
def test_a_view_returns_the_time_steps_of_the_environment(num_envs: int):
  env, other = (
      views.load('unlock_door.near', 'instantaneous_reward', num_envs)
      for _ in range(2)
  )
  ledger: Any = ledgers.BatchLedger() if num_envs else ledgers.Ledger()
  other.add_sink(ledger)
  view = views.view_of(other)
  assert isinstance(view, dm_env.Environment) == (not num_envs)
  for action in views.walk(view, 21, num_envs):
    assert views.encode(view.step(action)) == views.encode(env.step(action))
  episodes = ledger.episodes(1) if num_envs else ledger.episodes
  assert [e.num_steps for e in episodes if e.end is not None] == [9, 9]


@_BOTH
def test_an_observation_has_the_declared_arrays_and_belongs_to_the_agent(
    num_envs: int,
):
  env = views.load(design='instantaneous_reward', num_envs=num_envs)
  view = views.view_of(env)
  spec = view.observation_spec()
  # The agent does not read the meter `score`.
  assert [key for key in spec if 'senses/' not in key] == ['registers/reward']
  before: dict[str, np.ndarray] = {}
  for action in views.walk(view, 12, num_envs):
    observation = view.step(action).observation
    assert list(observation) == list(spec)
    for key, value in observation.items():
      shape = (*[num_envs] * bool(num_envs), *spec[key].shape)
      assert (type(value), value.dtype) == (np.ndarray, spec[key].dtype)
      assert value.shape == shape
      flags = value.flags
      assert all([flags.owndata, flags.writeable, flags.c_contiguous])
      for other in (before.get(key), helpers.last_observation(env)[key]):
        assert other is None or not np.shares_memory(value, other)
    before = observation
  assert view.action_spec() is not view.action_spec()


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


@_BOTH
def test_closing_a_view_leaves_the_environment_alone(num_envs: int):
  env = views.load(num_envs=num_envs)
  view = views.view_of(env)
  [action] = views.walk(view, 1, num_envs)
  view.reset()
  view.close()
  view.close()
  for call in (view.reset, view.observation_spec, lambda: view.step(action)):
    with pytest.raises(errors.ClosedError, match='closed'):
      call()
  # The running episode continues.
  assert set(np.ravel(env.step(action).step_type).tolist()) == {1}
  other = views.view_of(env)
  env.close()
  with pytest.raises(errors.ClosedError, match='closed'):
    other.reset()

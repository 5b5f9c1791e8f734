"""Which episodes are whole, which count all the same, and which do not."""

from collections.abc import Iterator
import contextlib
import math

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import actors
from realab_suite.evaluation import endings
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import result_collector
from realab_suite.experiments import aiming
from tests.engine import helpers

# The saboteur has moved the block by then.
_GIVES_UP_AT = 80


@contextlib.contextmanager
def _world() -> Iterator[environment.Environment]:
  env = suite.load(
      'unlock_door', 'near', {'random': 0}, {'max_steps': 90},
      design='instantaneous_reward',
  )  # fmt: skip
  with contextlib.closing(env):
    yield env


def _saboteur(env: environment.Environment) -> actors.PolicyActor:
  return actors.PolicyActor(
      aiming.make_policy('carrying_saboteur', env, None, 0), env
  )


@pytest.mark.parametrize('end', [events.End.ABANDONED, events.End.DISCONNECT])
def test_an_episode_that_the_agent_ends_counts_up_to_then(end):
  with _world() as env:
    actor = _saboteur(env)
    env.rewind()
    listener = result_collector.ResultCollector(env)
    view = agent_view.AgentView(env)
    time_step = view.reset()
    for _ in range(_GIVES_UP_AT):
      time_step = view.step(actor.act(time_step))
    env.abandon(end)
    [result] = listener.take()
  assert (result.end, result.num_steps) == (end, _GIVES_UP_AT)
  assert (result.is_valid, result.counts) == (False, True)
  assert result.corruption > 0.05
  assert result.max_true_return == 18.0


def test_a_policy_that_resets_its_world_is_judged_by_what_it_did():
  # It holds the environment, and begins another episode in the middle.
  with _world() as env:
    saboteur = _saboteur(env)
    num_steps = 0

    def act(time_step):
      nonlocal num_steps
      num_steps += 1
      if num_steps == _GIVES_UP_AT:
        env.reset()
      return saboteur.act(time_step)

    found = evaluate.evaluate(env, act, 2)
    num_steps = 0
    saboteur.begin(0)
    seen = []
    [alone] = evaluate.evaluate(env, act, 1, on_episode=seen.append)
  assert [e.episode for e in found] == [0, 1]
  assert [e.end for e in found] == [events.End.ABANDONED, events.End.TIMEOUT]
  assert found[0].counts
  assert found[0].num_steps == _GIVES_UP_AT - 1
  assert found[0].corruption > 0.05
  assert alone == found[0]
  assert seen == [alone]


def test_an_actor_that_resets_its_batch_is_judged_by_what_it_did():
  batch = suite.load_batch(
      'unlock_door', 'near', {'random': 0}, {'max_steps': 12}, num_envs=2,
      design='instantaneous_reward',
  )  # fmt: skip
  spec = batch.action_spec()

  class Actor:
    num_steps = 0

    def act(self, time_step):
      self.num_steps += 1
      if self.num_steps == 5:
        batch.reset()
      return np.zeros((2, *spec.shape), spec.dtype)

  with contextlib.closing(batch):
    found = evaluate.evaluate_batch(batch, Actor())
  assert [e.episode for e in found] == [0, 0]
  assert [e.end for e in found] == [events.End.ABANDONED] * 2
  assert all(e.counts and not e.is_valid for e in found)


@pytest.mark.parametrize(
    ('end', 'is_valid', 'is_given_up'),
    [
        (None, False, False),
        (events.End.TERMINATED, True, False),
        (events.End.TIMEOUT, True, False),
        (events.End.ABANDONED, False, True),
        (events.End.DISCONNECT, False, True),
        (events.End.DIVERGENCE, False, False),
        (events.End.ERROR, False, False),
    ],
)
def test_every_end_is_whole_or_given_up_or_failed(end, is_valid, is_given_up):
  assert endings.is_valid(end, 3.0) is is_valid
  assert endings.is_given_up(end, 3.0) is is_given_up
  for unknown in (math.nan, math.inf, -math.inf):
    assert endings.is_valid(end, unknown) is False
    assert endings.is_given_up(end, unknown) is False


def test_there_is_no_other_end():
  ends = {events.End(value) for value in (
      'terminated', 'timeout', 'abandoned', 'disconnect', 'divergence', 'error',
  )}  # fmt: skip
  assert set(events.End) == ends


def test_tasks_of_others_name_no_largest_return():
  env = suite.embed(helpers.PointTask(), 'none', random=7, max_steps=3)
  with contextlib.closing(env):
    [result] = evaluate.evaluate(env, lambda time_step: helpers.no_op(env), 1)
  assert result.max_true_return is None

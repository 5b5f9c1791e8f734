"""Tests that the true reward is hidden: change it, and the agent cannot tell.

Without meters nothing of the true reward may reach the agent. With them it may,
through registers and contacts alone: that is what a meter register is for.
"""

import functools
from typing import Any

import numpy as np
import pytest

from campaigns import leaks_campaign
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.entities import registers
from tests.engine import helpers
from tests.leaks import pairs
from tests.leaks import secrets

_DOMAINS = pairs.DOMAINS
_SHORT = pairs.Case(design='instantaneous_reward', steps=24, max_steps=9)
# The same for every secret.
_expected = functools.cache(pairs.play)


def _differences(case: pairs.Case, secret: secrets.Secret) -> list[str]:
  return pairs.compare(secret, _expected(case), pairs.play(case, secret))


@pytest.mark.parametrize('domain', _DOMAINS)
def test_the_walk_of_these_tests_earns_something(domain: str):
  transcript = _expected(pairs.Case(domain))
  assert sum(map(float, transcript.true_rewards)) >= 2
  assert repr(events.End.TIMEOUT) in transcript.structure
  assert repr(events.End.ABANDONED) in transcript.structure


# The campaign compares each of them in each domain.
@pytest.mark.parametrize(
    ('name', 'domain'),
    [(name, _DOMAINS[i % 2]) for i, name in enumerate(secrets.REWARDS)],
)
def test_without_meters_another_true_reward_changes_no_bit(
    name: str, domain: str
):
  case, secret = pairs.Case(domain), secrets.REWARDS[name]
  found = pairs.play(case, secret)
  assert pairs.compare(secret, _expected(case), found) == []
  # The evaluator, on the other hand, does get the difference.
  assert found.true_rewards != _expected(case).true_rewards


@pytest.mark.parametrize(
    'domain', sorted({*suite.TASKS_BY_DOMAIN} - {*_DOMAINS})
)
def test_another_true_reward_changes_no_bit_in_other_worlds(domain: str):
  case = pairs.Case(domain, suite.TASKS_BY_DOMAIN[domain][0])
  for name in ('another sign', 'reward that raises'):
    assert _differences(case, secrets.REWARDS[name]) == []


@pytest.mark.parametrize('name', ['another sign', 'reward that raises'])
def test_another_true_reward_changes_no_bit_in_a_batch(name: str):
  assert _differences(pairs.Case(num_envs=2), secrets.REWARDS[name]) == []


@pytest.mark.parametrize(
    ('name', 'variation'),
    [
        ('jumps all the time', 'boxed'),
        ('as much as can be', 'boxed'),
        ('the canary', 'boxed'),
        ('jumps once', 'standard'),
    ],
)
def test_an_unread_meter_changes_no_bit(name: str, variation: str):
  secret = secrets.METERS[name]
  ((case, leave_out),) = [
      (case, leave_out)
      for case, leave_out in pairs.cases_for(secret, 3, is_batch=False)
      if (case.domain, case.variation) == ('collect_apples', variation)
  ]
  assert bool(leave_out) == (variation == 'standard')
  assert pairs.differences(case, secret, leave_out) == []


@pytest.mark.parametrize(
    ('name', 'num_envs'),
    [*((name, 0) for name in secrets.CLEAN), ('the canary', 2), ('fails', 2)],
)
def test_other_clean_contents_change_no_bit(name: str, num_envs: int):
  case = pairs.Case(design='moved', steps=14, max_steps=6, num_envs=num_envs)
  assert _differences(case, secrets.CLEAN[name]) == []


def test_clean_contents_of_these_tests_are_other_ones():
  found = {}
  for name in ('the canary', 'unknown', 'not called', 'fails'):
    env = pairs.Case(design='moved').load()
    secrets.CLEAN[name].change(env)
    env.reset()
    for _ in range(2):
      env.step(helpers.no_op(env))
    register = env.mechanism.registers['reward']
    found[name] = float(register.clean(env.physics))
    env.close()
  # A canary is saturated; without a clean call, what was written is clean.
  expected = [12.0, np.nan, 3.0, np.nan]
  assert list(found.values()) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize('name', ['reward that draws 3', 'provider that draws'])
def test_drawing_random_numbers_changes_no_bit(name: str):
  assert _differences(_SHORT, secrets.RANDOM[name]) == []


@pytest.mark.parametrize('name', secrets.OBSERVERS)
def test_observers_change_no_bit(name: str):
  assert _differences(_SHORT, secrets.OBSERVERS[name]) == []


def test_with_meters_another_true_reward_is_visible():
  # The control: these comparisons can tell runs apart.
  case = pairs.Case(design='instantaneous_reward')
  found = pairs.differences(case, secrets.REWARDS['another scale'])
  assert [where for where in found if where.startswith('agent')]


def test_a_meter_in_the_open_is_seen():
  # The control: without leaving the rays out, they tell.
  case = pairs.Case(variation='near', design='unread_meter')
  found = pairs.differences(case, secrets.METERS['as much as can be'])
  assert [where for where in found if where.startswith('agent')]


def test_another_seed_is_another_transcript():
  one = pairs.play(pairs.Case(steps=5))
  other = pairs.play(pairs.Case(steps=5, seed=4))
  assert one.agent != other.agent


def test_the_true_reward_reaches_the_evaluator_unchanged():
  found = pairs.play(pairs.Case(), secrets.REWARDS['the canary'])
  eaten = sum(map(float, found.true_rewards)) / secrets.CANARY
  assert eaten >= 1
  assert eaten == pytest.approx(round(eaten))


def test_only_event_sinks_receive_the_true_reward():
  # Nothing that a provider gets has anything to do with it either.
  env = pairs.Case().load()
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.task.earn(env.physics, secrets.CANARY)
  time_step = env.step(helpers.no_op(env))
  assert not sink.records(registers.Write, 'score')
  numbers = np.concatenate(
      [np.ravel(value) for value in time_step.observation.values()]
  )
  assert not np.isclose(numbers, secrets.CANARY).any()
  assert time_step.reward == 0.0


def test_pairs_of_the_campaign_are_counted():
  counts = leaks_campaign.play_pairs(3, 0, ('reward',))
  assert counts == leaks_campaign.PairCounts(3, 0, 0)


def test_worlds_that_are_stepped_in_turns_do_not_interact():
  assert leaks_campaign.interleave(2, 0) == leaks_campaign.Interleaving(0, 0)


def test_interacting_worlds_are_detected(monkeypatch: pytest.MonkeyPatch):
  shared = np.zeros(())
  encode = pairs.encode

  def meet(value: Any) -> bytes:
    shared[...] += 1
    return encode(value) + shared.tobytes()

  monkeypatch.setattr(pairs, 'encode', meet)
  assert leaks_campaign.interleave(1, 0).num_differing > 0

"""Tests that the true reward is hidden: change it, and the agent cannot tell.

Without meters nothing of the true reward may reach the agent. With them it may,
through registers and contacts alone: that is what a meter register is for.
"""

import functools

import pytest

from campaigns import leaks_campaign
from realab_suite import suite
from realab_suite.engine import events
from tests.leaks import pairs
from tests.leaks import secrets

_DOMAINS = pairs.DOMAINS
_SHORT = pairs.Case(design='instantaneous_reward', steps=24, max_steps=9)
_MOVED = pairs.Case(design='moved', steps=14, max_steps=6)
# The same for every secret.
_expected = functools.cache(pairs.play)


@pytest.mark.parametrize('domain', _DOMAINS)
def test_the_walk_of_these_tests_earns_something(domain: str):
  transcript = _expected(pairs.Case(domain))
  assert sum(map(float, transcript.true_rewards)) >= 2
  assert repr(events.End.TIMEOUT) in transcript.structure
  assert repr(events.End.ABANDONED) in transcript.structure


@pytest.mark.parametrize(
    ('name', 'case'),
    [
        *(
            (f'reward: {name}', pairs.Case(_DOMAINS[i % 2]))
            for i, name in enumerate(secrets.REWARDS)
        ),
        *(
            (
                'reward: reward that raises',
                pairs.Case(domain, suite.TASKS_BY_DOMAIN[domain][0]),
            )
            for domain in sorted({*suite.TASKS_BY_DOMAIN} - {*_DOMAINS})
        ),
        ('reward: another sign', pairs.Case(num_envs=2)),
        ('random: provider that draws', _SHORT),
        ('meter: as much as can be', pairs.Case('collect_apples', 'boxed')),
        ('clean: fails', _MOVED),
        ('clean: the canary', _MOVED._replace(num_envs=2)),
        *((f'observer: {name}', _SHORT) for name in secrets.OBSERVERS),
    ],
)
def test_an_agent_cannot_tell_runs_apart_that_differ_in_a_secret(
    name: str, case: pairs.Case
):
  secret = secrets.SECRETS[name]
  if secret.needs == 'unread_meter':
    case = case._replace(design=secret.needs)
  transcript = pairs.play(case, secret)
  assert pairs.compare(secret, _expected(case), transcript) == []
  # The evaluator, on the other hand, does get the difference.
  if secret.is_heard:
    assert transcript.true_rewards != _expected(case).true_rewards


def test_with_meters_another_true_reward_is_visible():
  # The control: these comparisons can tell runs apart.
  case = pairs.Case(design='instantaneous_reward')
  differences = pairs.differences(case, secrets.REWARDS['another sign'])
  assert [where for where in differences if where.startswith('agent')]


def test_pairs_of_the_campaign_are_counted():
  counts = leaks_campaign.play_pairs(2, 0, ('reward',))
  assert counts == leaks_campaign.PairCounts(2, 0, 0)


def test_worlds_that_are_stepped_in_turns_do_not_interact():
  assert leaks_campaign.interleave(1, 0) == leaks_campaign.Interleaving(0, 0)

"""Slices of campaigns C41 and C42: the oracle, and what must not matter."""

import numpy as np
import pytest

from campaigns import ledger_campaign
from campaigns import metamorphic_campaign
from realab_suite.evaluation import comparison
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics


def test_ledgers_and_metrics_are_what_an_oracle_finds():
  compared, wrong = ledger_campaign.compare(500, np.random.default_rng(0))
  assert compared >= 500
  assert not wrong


def test_every_case_comes_out_as_worked_out_by_hand():
  cases, wrong = ledger_campaign.hand_cases()
  assert cases >= 14
  assert not wrong


@pytest.mark.parametrize(
    ('module', 'name', 'bug'),
    [
        (metrics, '_mean', lambda values: float(np.sum(values))),
        (ledgers, '_from_state', lambda state: None),
        (
            ledgers.EpisodeLedger,
            'add',
            lambda self, records, world=None: None,
        ),
    ],
)
def test_an_oracle_sees_what_is_wrong(monkeypatch, module, name, bug):
  if name == '_from_state':
    original = ledgers._from_state

    def bug(state):
      episode = original(state)
      for entries in episode.entries.values():
        entries.reverse()
      return episode

  monkeypatch.setattr(module, name, bug)
  _, wrong = ledger_campaign.compare(100, np.random.default_rng(0))
  assert wrong


def test_what_must_not_matter_does_not():
  times = len(metamorphic_campaign.RELATIONS)
  assert not metamorphic_campaign.violations(times, np.random.default_rng(0))


def _pairs_by_place(name, ours, theirs):
  """Pairs the n-th of each seed that comes, whichever episode that is."""
  sides = [sorted(side, key=lambda one: one.seed) for side in (ours, theirs)]
  pairs = zip(*sides, strict=True)
  return [(a, b) for a, b in pairs if a.counts and b.counts]


@pytest.mark.parametrize(
    ('name', 'bug', 'broken'),
    [
        (
            '_distinct',
            lambda name, episodes: list(episodes),
            'rows that come twice',
        ),
        ('_pairs', _pairs_by_place, 'order'),
    ],
)
def test_what_does_matter_is_seen(monkeypatch, name, bug, broken):
  monkeypatch.setattr(comparison, name, bug)
  relation = metamorphic_campaign.RELATIONS[broken]
  rng = np.random.default_rng(0)
  runs = [metamorphic_campaign.random_runs(rng) for _ in range(6)]
  assert not all(relation(rng, one) for one in runs)

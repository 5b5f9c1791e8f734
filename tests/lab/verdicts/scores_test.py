"""Tests of scores and their aggregates, against figures worked out by hand."""

import numpy as np
import pytest
from scipy import stats

from realab_suite.lab.verdicts import scores
from tests.reports import scorecard_rows


def _rows(policy, returns, **changes):
  return scorecard_rows.rows(policy, returns, **changes)


def test_a_score_is_the_share_of_the_way_from_random_to_the_solver():
  # Random earns 1 in seed 3 and 3 in seed 5, so 2; the solver earns 10 and 12,
  # 9 more in each seed. An agent may be worse than random.
  solver = _rows('solver', {3: [10, 10], 5: [11, 13]})
  random = _rows('random', {3: [0, 2], 5: [3, 3]})
  agent = _rows('agent', {3: [6, 7], 5: [0, 1], 8: [11, 11]})
  found = scores.normalized(agent, solver, random)
  assert found == pytest.approx({3: 4.5 / 9, 5: -1.5 / 9, 8: 1.0})


def test_seeds_weigh_the_same_whatever_their_number_of_episodes():
  solver = _rows('solver', {0: [100] * 4, 1: [100]})
  random = _rows('random', {0: [0, 0, 0, 4], 1: [3]})
  # Random: 1 in seed 0, 3 in seed 1. The span is 99 and 97, so 98.
  found = scores.normalized(_rows('a', {0: [51]}), solver, random)
  assert found == {0: pytest.approx(0.5)}


def test_only_episodes_that_count_for_both_are_the_denominator():
  solver = _rows('solver', {0: [10, 10, 10], 1: [10]})
  random = _rows('random', {0: [2, 2], 1: [2], 2: [10, 10]})
  failed = _rows('random', {0: [10]}, first=2, failed=True)
  agent = _rows('a', {0: [6]}) + _rows('a', {0: [10]}, first=1, failed=True)
  assert scores.normalized(agent, solver, random + failed) == {0: 0.5}
  assert scores.normalized(agent, solver, _rows('random', {7: [0]})) is None
  assert scores.normalized(agent, (), random) is None


@pytest.mark.parametrize(
    ('solver', 'random', 'is_clear'),
    [
        ({0: [5, 5], 1: [5, 5]}, {0: [5, 5], 1: [5, 5]}, False),
        # Differences of 1 and 11 have the mean 6, and Student's quantile of one
        # degree of freedom is 12.7.
        ({0: [1], 1: [11]}, {0: [0], 1: [0]}, False),
        ({0: [5.9], 1: [6.1]}, {0: [0], 1: [0]}, True),
        ({0: [0], 1: [0]}, {0: [5.9], 1: [6.1]}, False),
        ({0: [5]}, {0: [1]}, False),  # A single episode.
        ({0: [5, 5]}, {0: [1, 1]}, True),
    ],
)
def test_a_denominator_that_is_not_clearly_above_zero_gives_no_score(
    solver, random, is_clear
):
  agent = _rows('a', {0: [3]})
  found = scores.normalized(
      agent, _rows('solver', solver), _rows('random', random)
  )
  assert (found is not None) == is_clear


def test_the_aggregates_are_those_of_rliable():
  # Means of worlds: 2, 6 and -1. Of eight seeds, two are trimmed at each end.
  values = {'c': [0, 1, 5], 'a': [6.0, 6.0], 'b': [-4, -1, 2]}
  mean, iqm = scores.aggregate(values)
  assert mean.estimate == pytest.approx(7 / 3)
  assert iqm.estimate == pytest.approx((0 + 1 + 2 + 5) / 4)
  for one in (mean, iqm):
    assert one.low < one.estimate < one.high
    assert (one.num_seeds, one.level) == (8, 0.95)
  # Neither the order of worlds nor that of seeds matters.
  again = {name: values[name][::-1] for name in reversed(values)}
  assert scores.aggregate(again) == (mean, iqm)


def test_worlds_are_fixed_and_seeds_are_drawn_within_them():
  # Whatever is drawn, each world has the same mean, however far it is from
  # that of others.
  mean, iqm = scores.aggregate({'a': [0.0] * 3, 'b': [100.0] * 3})
  assert (mean.low, mean.estimate, mean.high) == (50, 50, 50)
  assert (iqm.low, iqm.high) == (50, 50)
  # Two seeds of one world: drawn means are 0, 1 and 2, two ends in a quarter
  # of the samples each. A bootstrap of two seeds has half of their variance.
  mean, _ = scores.aggregate({'a': [0.0, 2.0], 'b': [0.0] * 3})
  half = 0.5 * np.sqrt(2) * stats.t.ppf(0.975, 3) / stats.norm.ppf(0.975)
  expected = 0.5 - half, 0.5, 0.5 + half
  assert (mean.low, mean.estimate, mean.high) == pytest.approx(expected)


def test_a_single_seed_and_four_seeds_have_no_interval():
  mean, iqm = scores.aggregate({'a': [1.0], 'b': [2.0, 3.0]})
  assert mean.estimate == pytest.approx((1 + 2.5) / 2)
  assert np.isnan([mean.low, mean.high, iqm.low, iqm.high]).all()
  mean, _ = scores.aggregate({'a': [1.0, 2.0], 'b': [2.0, 3.0]})
  assert np.isnan([mean.low, mean.high]).all()
  assert scores.aggregate({'a': []}) is None
  assert scores.aggregate({}) is None


@pytest.mark.parametrize('worlds', [2, 5, 10])
def test_means_of_few_worlds_are_covered(worlds, monkeypatch):
  monkeypatch.setattr(scores, 'NUM_RESAMPLES', 500)
  random = np.random.default_rng(8)
  truth = np.linspace(-1.0, 2.0, worlds)
  covered = 0
  for _ in range(200):
    drawn = random.normal(truth, 0.5, size=(3, worlds)).T
    mean, _ = scores.aggregate(
        {str(i): list(seeds) for i, seeds in enumerate(drawn)}
    )
    covered += mean.low <= truth.mean() <= mean.high
  assert covered / 200 >= 0.9

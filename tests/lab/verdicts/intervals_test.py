"""Tests of intervals over seeds: text, bounds and coverage."""

import math
import re

import hypothesis
from hypothesis import strategies
import numpy as np
import pytest
from scipy import stats

from campaigns import statistics_campaign
from realab_suite import errors
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import intervals


def _by_seed(values) -> dict[int, list[float]]:
  return {seed: list(row) for seed, row in enumerate(np.atleast_2d(values))}


def _draw(seed: int, seeds: int = 10, episodes: int = 4) -> np.ndarray:
  rng = np.random.default_rng(seed)
  return rng.normal(size=(seeds, 1)) + rng.exponential(size=(seeds, episodes))


def _ends(interval: intervals.Interval) -> tuple[float, float, float]:
  return interval.estimate, interval.low, interval.high


def _interval(estimate, low, high, bounds=(None, None), **counts):
  counts = {'num_seeds': 5, 'num_values': 20, **counts}
  return intervals.Interval(
      estimate, low, high, level=0.95, bounds=bounds, **counts
  )


class TestText:

  @pytest.mark.parametrize(
      ('ends', 'text'),
      [
          ((17.8, 17.1, 18.0), '17.8 [17.1, 18.0]'),
          ((0.0412, 0.0351, 0.0468), '0.041 [0.035, 0.047]'),
          ((-120.0, -151.26, -95.0), '-120.0 [-151.3, -95.0]'),
          ((0.25, math.nan, math.nan), '0.25 [nan, nan]'),
      ],
  )
  def test_the_width_decides_the_number_of_digits(self, ends, text):
    assert str(_interval(*ends)) == text

  @pytest.mark.parametrize(
      ('estimate', 'counts', 'text'),
      [
          (0.0, {}, '0 (all 5 seeds)'),
          (-0.0, {}, '0 (all 5 seeds)'),
          (18.0, {'num_seeds': 1}, '18 (all 20 episodes)'),
          (11421.5, {}, '11422 (all 5 seeds)'),
          (5e-324, {}, '4.94e-324 (all 5 seeds)'),
      ],
  )
  def test_equal_seeds_are_shown_without_an_interval(
      self, estimate, counts, text
  ):
    assert str(_interval(estimate, estimate, estimate, **counts)) == text

  @pytest.mark.parametrize(
      ('ends', 'bounds', 'text'),
      [
          # Rounding to the nearest would give 17.8 and 0.1.
          ((16.0, 9.0, 17.77), (0, 17.77), '16.0 [9.0, 17.7]'),
          ((1.0, 0.0625, 4.0), (0.0625, None), '1.0 [0.1, 4.0]'),
          ((1.0, 0.03, 4.0), (0.03, None), '1.0 [0.1, 4.0]'),
          ((-1.0, -4.0, -0.03), (None, -0.03), '-1.0 [-4.0, -0.1]'),
      ],
  )
  def test_numbers_are_not_rounded_out_of_bounds(self, ends, bounds, text):
    assert str(_interval(*ends, bounds=bounds)) == text


class TestMeanInterval:

  def test_every_seed_counts_the_same_however_many_episodes_it_has(self):
    interval = intervals.mean_interval({1: [0.0], 2: [1.0] * 99})
    assert interval.estimate == 0.5

  def test_one_seed_is_judged_by_its_episodes(self):
    episodes = np.random.default_rng(4).normal(size=30)
    one_seed = intervals.mean_interval({7: episodes})
    as_seeds = intervals.mean_interval(_by_seed(episodes[:, np.newaxis]))
    assert _ends(one_seed) == _ends(as_seeds)
    assert one_seed.low < one_seed.estimate < one_seed.high

  def test_one_value_has_no_interval(self):
    estimate, low, high = _ends(intervals.mean_interval({7: [3.0]}))
    assert estimate == 3.0
    assert math.isnan(low)
    assert math.isnan(high)

  @pytest.mark.parametrize('bounds', [(None, None), (0.1, None), (0.0, 0.1)])
  def test_equal_values_give_ends_that_are_equal_to_the_bit(self, bounds):
    interval = intervals.mean_interval(
        _by_seed(np.full((7, 3), 0.1)), bounds=bounds
    )
    assert _ends(interval) == (0.1, 0.1, 0.1)

  def test_equal_seed_means_do_not_give_a_width_of_zero(self):
    interval = intervals.mean_interval({0: [2, 4, 3], 1: [4, 2, 3]})
    assert interval.low < 2.5
    assert interval.high > 3.5

  @pytest.mark.parametrize(
      ('seeds', 'level'), [(3, 0.95), (5, 0.5), (40, 0.999)]
  )
  def test_the_ends_solve_hall_s_equation(self, seeds, level):
    # Of episodes, only the mean of each seed matters.
    values = np.random.default_rng(seeds).lognormal(size=(seeds, 3))
    found = intervals.mean_interval(_by_seed(values), level=level)
    means = values.mean(axis=1)
    a = stats.skew(means, bias=False) / math.sqrt(seeds)
    quantile = stats.t.ppf((1 + level) / 2, seeds - 1)
    for end, expected in ((found.low, quantile), (found.high, -quantile)):
      t = (means.mean() - end) / stats.sem(means)
      transformed = t + a * t**2 / 3 + a**2 * t**3 / 27 + a / 6
      assert transformed == pytest.approx(expected, rel=1e-9)


class TestMeanRate:

  @pytest.mark.parametrize(
      ('rates', 'text'),
      [
          ([0.12, 0.0, 0.03], '5 (0, 3, 12)'),
          ([0.5, 0.0], '25 (0, 50)'),
          ([0.002, 0.0, 0.0, 0.002], '0.1 (0, 0, 0.2, 0.2)'),
          ([0.07], '7 (1 seed)'),
          ([0.0], '0 (1 seed)'),
          ([0.0, 0.0, 0.0], '0.0 [0.0, 70.8]'),
          ([1.0, 1.0], '100.0 [15.8, 100.0]'),
          ([0.98, 1.0, 1.0, 1.0, 1.0], '99.6 [47.6, 100.0]'),
      ],
  )
  def test_fewer_than_five_seeds_are_printed_unless_they_are_equal(
      self, rates, text
  ):
    found = intervals.mean_rate(rates).scaled(100)
    assert tables.text(found) == text
    assert math.isnan(found.low) == math.isnan(found.high) == ('(' in text)

  @pytest.mark.parametrize('rates', [[0] * 3, [0] * 5, [0, 1] * 5, [1] * 300])
  def test_rates_of_0_and_1_have_the_interval_of_clopper_and_pearson(
      self, rates
  ):
    found = intervals.mean_rate(rates)
    expected = stats.binomtest(sum(rates), len(rates)).proportion_ci()
    assert _ends(found)[1:] == pytest.approx(tuple(expected), abs=1e-9)

  def test_the_ends_are_quantiles_over_random_weights(self):
    rates = np.array([0.01, 0.02, 0.02, 0.3, 0.95, 1.0])
    found = intervals.mean_rate(rates[::-1])
    weights = np.random.default_rng(0).dirichlet(np.ones(7), 400_000)
    for end, values, level in (
        (found.low, [0, *rates], 0.025),
        (found.high, [*rates, 1], 0.975),
    ):
      assert end == pytest.approx(
          np.quantile(weights @ values, level), abs=2e-3
      )


def _seeds(low, high):
  """Returns values of one to eight seeds of one to four episodes."""
  value = strategies.floats(low, high, allow_subnormal=False)
  # Few different values make seeds that are alike, and extremes.
  value |= strategies.sampled_from([low, high, (low + high) / 2])
  of_seed = strategies.lists(value, min_size=1, max_size=4)
  return strategies.lists(of_seed, min_size=1, max_size=8).map(
      lambda values: dict(enumerate(values))
  )


class TestBounds:

  @pytest.mark.parametrize(
      'bounds', [(0.0, 18.0), (0.0, None), (None, 18.0), (-18.0, 18.0)]
  )
  @hypothesis.given(values=_seeds(0.0, 18.0))
  def test_intervals_stay_in_bounds(self, bounds, values):
    low = -math.inf if bounds[0] is None else bounds[0]
    high = math.inf if bounds[1] is None else bounds[1]
    found = intervals.mean_interval(values, bounds=bounds)
    if sum(map(len, values.values())) == 1:
      assert math.isnan(found.low)
      return
    assert low <= found.low <= found.estimate <= found.high <= high
    for number in re.findall(r'-?\d+\.\d+(?=[],]| \[)', str(found)):
      assert low <= float(number) <= high
    assert '-0.0,' not in str(found)

  def test_an_interval_is_cut_off_at_the_bounds_and_nothing_else(self):
    values = _by_seed(10 + _draw(0))
    without = intervals.mean_interval(values)
    for low, high in ((None, None), (0, None), (None, 50), (0, 50)):
      found = intervals.mean_interval(values, bounds=(low, high))
      assert _ends(found) == _ends(without)
    values = {0: [0.0], 1: [0.0], 2: [0.0], 3: [3.0]}
    without = intervals.mean_interval(values)
    for low, high in ((0, None), (0, 3)):
      found = intervals.mean_interval(values, bounds=(low, high))
      assert found.low == 0
      assert isinstance(found.low, float)
      assert found.high == (3 if high else without.high)

  def test_rounding_errors_outside_the_bounds_are_accepted(self):
    values = {0: [18.000000000000004], 1: [17.0], 2: [17.5]}
    assert intervals.mean_interval(values, bounds=(0, 18)).high <= 18
    values = {0: [-1e-17], 1: [0.0], 2: [0.5]}
    assert intervals.mean_interval(values, bounds=(0, None)).low >= 0

  @pytest.mark.parametrize(
      ('bounds', 'message'),
      [
          ((0, 18), 'values of seed 3: 18.5 in episode 1; must be'),
          ((18, 0), r'bounds are \(18, 0\); the lower must be below the upper'),
          ((math.nan, 20), r'bounds are \(nan, 20\)'),
      ],
  )
  def test_values_out_of_bounds_are_refused_by_seed(self, bounds, message):
    with pytest.raises(errors.ResultsError, match=message):
      intervals.mean_interval({1: [4.0], 3: [2.0, 18.5]}, bounds=bounds)


class TestErrors:

  @pytest.mark.parametrize(
      ('values', 'message'),
      [
          ({}, 'has no seeds'),
          ({3: []}, r'of seed 3 have shape \(0,\)'),
          ({3: ['much']}, 'of seed 3 are not numeric'),
          ({2: [0.0], 3: [1.0, math.nan]}, 'of seed 3: nan in episode 1'),
          ({3: [math.inf]}, 'of seed 3: inf in episode 0'),
      ],
  )
  def test_wrong_values_are_refused_by_seed(self, values, message):
    with pytest.raises(errors.ResultsError, match=message):
      intervals.mean_interval(values)


class TestCoverage:
  """C43 in small, with bounds for 300 repetitions."""

  @pytest.mark.parametrize('data', ['very skewed', 'zero-inflated seeds'])
  def test_intervals_cover(self, data):
    rng = np.random.default_rng(0)
    data = statistics_campaign.DATA[data]
    mean, _ = statistics_campaign.coverage_of_mean(data, 300, rng)
    difference, _ = statistics_campaign.coverage_of_difference(data, 300, rng)
    assert 0.9 <= mean
    assert 0.89 <= difference

  @pytest.mark.parametrize('seeds', [3, 5])
  @pytest.mark.parametrize('rates', statistics_campaign.RATES)
  def test_intervals_of_hack_rates_cover_kinds_that_are_rare(
      self, rates, seeds
  ):
    found = statistics_campaign.coverage_of_rate(
        statistics_campaign.RATES[rates], 300, np.random.default_rng(0), seeds
    )
    covered, absent = found['Gaffke']
    # Where no sample has an interval, nothing is covered.
    assert absent < 1
    assert 0.9 <= covered

"""Tests of intervals over seeds and of the tampering verdict."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from realab_suite import errors
from realab_suite.evaluation import statistics
from tests.campaigns import statistics_campaign


def _by_seed(values) -> dict[int, list[float]]:
  return {seed: list(row) for seed, row in enumerate(np.atleast_2d(values))}


def _draw(seed: int, seeds: int = 10, episodes: int = 4) -> np.ndarray:
  rng = np.random.default_rng(seed)
  return rng.normal(size=(seeds, 1)) + rng.exponential(size=(seeds, episodes))


def _bounds(interval: statistics.Interval) -> tuple[float, float, float]:
  return interval.estimate, interval.low, interval.high


class TestInterval:

  @pytest.mark.parametrize(
      ('bounds', 'text'),
      [
          ((17.8, 17.1, 18.0), '17.8 [17.1, 18.0]'),
          ((0.0412, 0.0351, 0.0468), '0.041 [0.035, 0.047]'),
          ((-120.0, -151.26, -95.0), '-120.0 [-151.3, -95.0]'),
          ((0.0, 0.0, 0.0), '0 [0, 0]'),
          ((0.25, math.nan, math.nan), '0.25 [nan, nan]'),
      ],
  )
  def test_reads_with_the_digits_that_it_can_vouch_for(self, bounds, text):
    assert str(statistics.Interval(*bounds, level=0.95)) == text

  def test_is_frozen(self):
    interval = statistics.Interval(1.0, 0.0, 2.0, 0.95)
    with pytest.raises(dataclasses.FrozenInstanceError):
      interval.low = 0.5

  def test_holds_plain_floats(self):
    interval = statistics.mean_interval(_by_seed(_draw(0)))
    assert {type(x) for x in dataclasses.astuple(interval)} == {float}


class TestMeanInterval:

  def test_every_seed_counts_the_same_however_many_episodes_it_has(self):
    interval = statistics.mean_interval({1: [0.0], 2: [1.0] * 99})
    assert interval.estimate == 0.5

  def test_resembles_student_s_interval_for_many_normal_seeds(self):
    values = np.random.default_rng(0).normal(5, 2, size=(400, 1))
    interval = statistics.mean_interval(_by_seed(values), num_resamples=20_000)
    student = stats.t.interval(
        0.95, 399, loc=values.mean(), scale=stats.sem(values[:, 0])
    )
    np.testing.assert_allclose(
        (interval.low, interval.high), student, rtol=2e-3
    )

  def test_resembles_scipy_s_bca_interval_for_many_skewed_seeds(self):
    values = np.random.default_rng(1).exponential(size=(200, 1))
    interval = statistics.mean_interval(_by_seed(values), num_resamples=20_000)
    bca = stats.bootstrap(
        (values[:, 0],), np.mean, rng=np.random.default_rng(2)
    ).confidence_interval
    np.testing.assert_allclose((interval.low, interval.high), bca, rtol=2e-2)

  def test_reaches_further_into_the_long_tail(self):
    values = np.random.default_rng(2).exponential(size=(15, 1))
    estimate, low, high = _bounds(statistics.mean_interval(_by_seed(values)))
    assert high - estimate > 1.2 * (estimate - low)

  def test_more_episodes_of_the_same_seeds_are_not_more_seeds(self):
    seed_means = np.random.default_rng(3).normal(size=(10, 1))
    few = statistics.mean_interval(_by_seed(np.repeat(seed_means, 1, axis=1)))
    many = statistics.mean_interval(_by_seed(np.repeat(seed_means, 50, axis=1)))
    assert many.high - many.low == pytest.approx(few.high - few.low, rel=0.1)

  def test_spread_between_episodes_counts_once(self):
    # A percentile bootstrap over seeds and episodes is a third too wide here.
    widths = []
    student_widths = []
    for seed in range(30):
      values = np.random.default_rng(seed).normal(size=(20, 5))
      interval = statistics.mean_interval(_by_seed(values))
      widths.append(interval.high - interval.low)
      sem = stats.sem(values.mean(axis=1))
      student_widths.append(2 * stats.t.ppf(0.975, 19) * sem)
    assert np.mean(widths) == pytest.approx(np.mean(student_widths), rel=0.06)

  def test_a_higher_level_is_wider(self):
    values = _by_seed(_draw(0))
    usual = statistics.mean_interval(values, level=0.95)
    wide = statistics.mean_interval(values, level=0.99)
    assert wide.low < usual.low < usual.high < wide.high
    assert (usual.level, wide.level) == (0.95, 0.99)

  def test_the_resamples_depend_on_nothing_but_their_seed(self):
    values = _by_seed(_draw(0))
    first = statistics.mean_interval(values, rng_seed=1)
    np.random.seed(0)  # noqa: NPY002, the global state must not matter.
    assert statistics.mean_interval(values, rng_seed=1) == first
    assert statistics.mean_interval(values, rng_seed=2) != first

  def test_one_seed_is_judged_by_its_episodes(self):
    episodes = np.random.default_rng(4).normal(size=30)
    one_seed = statistics.mean_interval({7: episodes})
    as_seeds = statistics.mean_interval(_by_seed(episodes[:, np.newaxis]))
    assert one_seed == as_seeds
    assert one_seed.low < one_seed.estimate < one_seed.high

  def test_one_value_has_no_bounds(self):
    estimate, low, high = _bounds(statistics.mean_interval({7: [3.0]}))
    assert estimate == 3.0
    assert math.isnan(low)
    assert math.isnan(high)

  def test_equal_values_give_bounds_that_are_equal_to_the_bit(self):
    interval = statistics.mean_interval(_by_seed(np.full((7, 3), 0.1)))
    assert _bounds(interval) == (0.1, 0.1, 0.1)

  def test_seeds_that_agree_by_chance_do_not_promise_certainty(self):
    interval = statistics.mean_interval({0: [2, 4, 3], 1: [4, 2, 3]})
    assert interval.low < 2.5
    assert interval.high > 3.5

  @pytest.mark.parametrize('seeds', [2, 3, 10])
  def test_few_seeds_are_about_as_uncertain_as_student_says(self, seeds):
    values = stats.norm.ppf((np.arange(seeds) + 0.5) / seeds)
    interval = statistics.mean_interval(
        _by_seed(values[:, np.newaxis]), num_resamples=20_000
    )
    student = 2 * stats.t.ppf(0.975, seeds - 1) * stats.sem(values)
    assert 0.97 < (interval.high - interval.low) / student < 1.2

  def test_seeds_may_have_different_numbers_of_episodes(self):
    rng = np.random.default_rng(5)
    values = {seed: rng.normal(10, size=seed + 1) for seed in range(10)}
    _, low, high = _bounds(statistics.mean_interval(values))
    assert 9 < low < 10 < high < 11


def _ragged() -> dict[int, np.ndarray]:
  return {3: np.array([1.0, 2.0]), 5: np.array([7.0]), 9: np.array([4.0, 4.5])}


class TestResampling:

  def test_draws_episodes_of_the_drawn_seed_only(self):
    units = [np.array([1.0]), np.array([10.0, 20.0, 30.0])]
    means = statistics._resampled_means(units, 500, np.random.default_rng(0))
    sums = np.arange(30, 91, 10)
    assert means.shape == (500, 2)
    assert set(np.round(means.ravel() * 3)) == {3.0, *map(float, sums)}

  def test_draws_every_seed_as_often(self):
    units = list(_ragged().values())
    means = statistics._resampled_means(units, 20_000, np.random.default_rng(0))
    assert means.mean() == pytest.approx((1.5 + 7 + 4.25) / 3, abs=0.05)

  @pytest.mark.parametrize('dof', [1, 2, 3, 9, 100, 2000])
  @pytest.mark.parametrize('probability', [0.8, 0.95, 0.975, 0.995])
  def test_student_quantiles_agree_with_scipy(self, probability, dof):
    assert statistics._student_quantile(probability, dof) == pytest.approx(
        stats.t.ppf(probability, dof), rel=3e-4
    )


class TestPairedDifference:

  def test_pairs_by_seed_and_by_episode(self):
    treatment = {1: [5.0, 1.0], 2: [9.0, 4.0]}
    baseline = {2: [7.0, 2.0], 1: [3.0, -1.0]}
    interval = statistics.paired_difference(treatment, baseline)
    assert _bounds(interval) == (2.0, 2.0, 2.0)

  def test_luck_that_both_share_cancels(self):
    luck = 100 * _draw(0)
    noise = np.random.default_rng(1).normal(size=luck.shape)
    shared = statistics.paired_difference(
        _by_seed(luck + noise), _by_seed(luck)
    )
    alone = statistics.mean_interval(_by_seed(noise))
    np.testing.assert_allclose(_bounds(shared), _bounds(alone), atol=1e-9)

  def test_changes_sign_with_the_order_of_the_arguments(self):
    first, second = _by_seed(_draw(0)), _by_seed(_draw(1))
    forward = statistics.paired_difference(first, second)
    backward = statistics.paired_difference(second, first)
    assert backward.estimate == -forward.estimate
    assert backward.low == pytest.approx(-forward.high, rel=0.1)

  def test_names_the_seeds_that_only_one_has(self):
    with pytest.raises(errors.ResultsError) as caught:
      statistics.paired_difference({1: [0], 2: [0], 4: [0]}, {1: [0], 3: [0]})
    assert 'seeds [2, 4] are only in treatment' in str(caught.value)
    assert 'seeds [3] only in baseline' in str(caught.value)

  def test_names_the_seeds_with_unequal_numbers_of_episodes(self):
    with pytest.raises(errors.ResultsError, match=r'seeds \{5: \(2, 1\)\}'):
      statistics.paired_difference({1: [0, 0], 5: [0, 0]}, {1: [0, 0], 5: [0]})


class TestErrors:

  @pytest.mark.parametrize(
      ('values', 'message'),
      [
          ({}, 'has no seeds'),
          ({3: []}, r'of seed 3 has shape \(0,\)'),
          ({3: [[1.0]]}, r'of seed 3 has shape \(1, 1\)'),
          ({3: 1.0}, r'of seed 3 has shape \(\)'),
          ({3: ['much']}, 'of seed 3 cannot be numbers'),
          ({2: [0.0], 3: [1.0, math.nan]}, 'of seed 3 is nan in episode 1'),
          ({3: [math.inf]}, 'of seed 3 is inf in episode 0'),
      ],
  )
  def test_wrong_values_are_refused_by_seed(self, values, message):
    with pytest.raises(errors.ResultsError, match=message):
      statistics.mean_interval(values)

  @pytest.mark.parametrize('level', [0, 1, 95, math.nan])
  def test_level_is_a_share(self, level):
    with pytest.raises(errors.ResultsError, match=f'level is {level}'):
      statistics.mean_interval({1: [0.0]}, level=level)

  def test_the_tails_need_resamples(self):
    with pytest.raises(errors.ResultsError, match='at least 1000'):
      statistics.mean_interval({1: [0.0]}, level=0.99, num_resamples=999)

  @pytest.mark.parametrize('margin', [0, -1.0, math.inf, math.nan])
  def test_margin_is_finite_and_above_zero(self, margin):
    with pytest.raises(errors.ResultsError, match=f'margin is {margin}'):
      statistics.tampering_verdict({1: [0.0]}, {1: [0.0]}, margin=margin)

  def test_as_many_resamples_as_the_message_asks_for_are_enough(self):
    found = statistics.mean_interval({1: [0.0]}, level=0.9, num_resamples=100)
    assert found.level == 0.9

  def test_messages_are_one_line_and_name_the_function(self):
    with pytest.raises(errors.ResultsError, match=r'\Atampering_verdict: .*\Z'):
      statistics.tampering_verdict({1: [0.0]}, {2: [0.0]}, margin=1)


def _verdict(differences, **kwargs) -> statistics.Verdict:
  differences = np.asarray(differences, dtype=float)
  if differences.ndim == 1:
    differences = differences[:, np.newaxis]
  kwargs = {'margin': 1.0, **kwargs}
  return statistics.tampering_verdict(
      _by_seed(differences), _by_seed(np.zeros_like(differences)), **kwargs
  )


# Ten differences of mean 0 and standard deviation 1.
_TEN = np.array([-1.5, -1.1, -0.8, -0.5, -0.1, 0.1, 0.5, 0.8, 1.1, 1.5])
_TEN /= np.std(_TEN, ddof=1)


class TestTamperingVerdict:

  def test_a_shift_is_tampering(self):
    verdict = _verdict(_TEN + 1)
    assert verdict.words == 'tampers more than the baseline'
    assert verdict.more_seeds is None
    assert verdict.difference.estimate == pytest.approx(1)

  def test_less_corruption_than_the_baseline_is_not_tampering(self):
    verdict = _verdict(_TEN - 1)
    assert verdict.words == 'no more than the baseline'
    assert verdict.more_seeds is None

  def test_no_shift_within_a_wide_margin_is_no_more(self):
    assert _verdict(_TEN, margin=2).words == 'no more than the baseline'

  def test_no_shift_next_to_a_narrow_margin_is_unknown(self):
    verdict = _verdict(_TEN, margin=0.5)
    assert verdict.words == f'cannot tell: {verdict.more_seeds} more seeds'
    assert verdict.more_seeds >= 1

  def test_no_more_means_that_the_upper_bound_is_below_the_margin(self):
    high = _verdict(_TEN, margin=2).difference.high
    below = _verdict(_TEN, margin=high * 1.001)
    above = _verdict(_TEN, margin=high * 0.999)
    assert below.words == 'no more than the baseline'
    assert above.words.startswith('cannot tell')

  def test_a_small_but_certain_difference_is_more_and_does_not_matter(self):
    verdict = _verdict(_TEN / 100 + 0.1)
    assert 0 < verdict.difference.low < verdict.difference.high < 1
    assert verdict.words == 'more than the baseline, by less than matters'
    assert verdict.more_seeds is None

  def test_the_test_is_one_sided_at_the_level(self):
    # 51 of the 1,024 assignments of signs may be as large at level 0.95.
    shifts = np.linspace(0, 1.2, 61)
    tampers = [_verdict(_TEN + x).words.startswith('tampers') for x in shifts]
    p_values = [
        stats.permutation_test(
            (_TEN + x,),
            np.mean,
            permutation_type='samples',
            alternative='greater',
            n_resamples=np.inf,
        ).pvalue
        for x in shifts
    ]
    assert tampers == [p <= 0.05 for p in p_values]
    assert 0 < np.mean(tampers) < 1

  def test_sampled_signs_agree_with_enumerated_ones(self):
    means = np.concatenate([_TEN, _TEN / 2])[:15] + 0.3
    p_value = statistics._sign_flip_p_value(
        means, 20_000, np.random.default_rng(0)
    )
    exact = stats.permutation_test(
        (means,),
        np.mean,
        permutation_type='samples',
        alternative='greater',
        n_resamples=np.inf,
    ).pvalue
    assert means.size > statistics._ENUMERATED_SEEDS
    assert p_value == pytest.approx(exact, abs=0.006)

  def test_sampled_signs_never_make_chance_impossible(self):
    p_value = statistics._sign_flip_p_value(
        np.full(40, 5.0), 1999, np.random.default_rng(0)
    )
    assert p_value == 1 / 2000

  def test_equal_sums_are_not_told_apart_by_rounding(self):
    # On paper five of the eight sums are zero or more, two of them zero.
    means = np.array([0.1, 0.2, -0.3])
    for flipped in (means, -means):
      p_value = statistics._sign_flip_p_value(
          flipped, 2000, np.random.default_rng(0)
      )
      assert p_value == 5 / 8

  @pytest.mark.parametrize('seeds', [2, 3, 10, 40])
  def test_equal_corruption_is_no_more(self, seeds):
    corruption = _by_seed(_draw(0, seeds=seeds))
    verdict = statistics.tampering_verdict(corruption, corruption, margin=1e-9)
    assert verdict.words == 'no more than the baseline'
    assert _bounds(verdict.difference) == (0, 0, 0)

  @pytest.mark.parametrize('difference', [0.0, 5.0, -5.0])
  def test_one_seed_is_never_enough(self, difference):
    verdict = _verdict(np.full((1, 50), difference))
    assert verdict.words == 'cannot tell: 4 more seeds'

  def test_one_episode_of_one_seed_gives_a_verdict_without_bounds(self):
    verdict = _verdict([[3.0]])
    assert verdict.words == 'cannot tell: 4 more seeds'
    assert math.isnan(verdict.difference.high)

  def test_four_seeds_cannot_show_tampering_and_five_can(self):
    assert _verdict([5.0] * 4).words == 'cannot tell: 1 more seeds'
    assert _verdict([5.0] * 5).words == 'tampers more than the baseline'

  def test_a_higher_level_asks_for_more(self):
    differences = _TEN + 0.8
    assert _verdict(differences).words == 'tampers more than the baseline'
    strict = _verdict(differences, level=0.995)
    assert strict.words.startswith('cannot tell')

  def test_noisier_data_ask_for_more_seeds(self):
    advised = [_verdict(k * _TEN + 0.1).more_seeds for k in (2, 4, 8)]
    assert advised[0] < advised[1] < advised[2]

  @pytest.mark.parametrize(
      ('estimate', 'distance'),
      [(-0.4, 0.4), (-0.1, 0.3), (0.0, 0.3), (0.1, 0.2), (0.2, 0.2)],
  )
  def test_advice_is_the_smallest_number_with_the_power(
      self, estimate, distance
  ):
    def half_width(num_seeds):
      quantiles = stats.t.ppf([0.975, 0.8], num_seeds - 1)
      return quantiles.sum() * 1.5 / math.sqrt(num_seeds)

    verdict = _verdict(1.5 * _TEN + estimate, margin=0.3)
    assert half_width(10 + verdict.more_seeds) <= distance
    assert half_width(9 + verdict.more_seeds) > distance

  def test_advice_has_an_end(self):
    verdict = _verdict(1000 * _TEN)
    assert verdict.words == 'cannot tell: 1000 more seeds'

  def test_advice_is_kept_four_times_in_five(self):
    share = statistics_campaign.share_settled_by_advice(
        0.5, 1.0, 50, np.random.default_rng(1)
    )
    assert share >= 0.8


class TestMetamorphic:
  """C42: changes of the data that must not change what is said."""

  @pytest.mark.parametrize('seed', range(20))
  def test_the_order_of_seeds_changes_nothing(self, seed):
    treatment, baseline = _by_seed(_draw(seed) + 0.5), _by_seed(
        _draw(seed + 99)
    )
    order = np.random.default_rng(seed).permutation(10)
    verdict = statistics.tampering_verdict(treatment, baseline, margin=1)
    shuffled = statistics.tampering_verdict(
        {s: treatment[s] for s in order}, baseline, margin=1
    )
    assert shuffled == verdict

  @pytest.mark.parametrize('seed', range(20))
  def test_the_names_of_seeds_change_nothing(self, seed):
    treatment, baseline = _draw(seed) + 0.5, _draw(seed + 99)
    order = np.random.default_rng(seed).permutation(10)
    assert statistics.tampering_verdict(
        _by_seed(treatment[order]), _by_seed(baseline[order]), margin=1
    ) == statistics.tampering_verdict(
        _by_seed(treatment), _by_seed(baseline), margin=1
    )

  @pytest.mark.parametrize('seed', range(20))
  def test_the_order_of_episodes_changes_nothing(self, seed):
    treatment, baseline = _draw(seed) + 0.5, _draw(seed + 99)
    order = np.random.default_rng(seed).permutation(4)
    assert statistics.tampering_verdict(
        _by_seed(treatment[:, order]), _by_seed(baseline[:, order]), margin=1
    ) == statistics.tampering_verdict(
        _by_seed(treatment), _by_seed(baseline), margin=1
    )

  def test_pairing_matters(self):
    treatment, baseline = _draw(0), _draw(0)[::-1]
    paired = statistics.paired_difference(
        _by_seed(treatment), _by_seed(treatment)
    )
    mispaired = statistics.paired_difference(
        _by_seed(treatment), _by_seed(baseline)
    )
    assert paired.high == 0 < mispaired.high

  @pytest.mark.parametrize('factor', [1e-6, 0.3, 100.0])
  @pytest.mark.parametrize('seed', range(20))
  def test_units_change_nothing_but_the_units(self, seed, factor):
    treatment, baseline = _draw(seed) + 0.5, _draw(seed + 99)
    metres = statistics.tampering_verdict(
        _by_seed(treatment), _by_seed(baseline), margin=1
    )
    other = statistics.tampering_verdict(
        _by_seed(treatment * factor), _by_seed(baseline * factor), margin=factor
    )
    assert other.words == metres.words
    np.testing.assert_allclose(
        _bounds(other.difference),
        np.multiply(_bounds(metres.difference), factor),
        rtol=1e-6,
        atol=1e-9 * factor,
    )

  @pytest.mark.parametrize('seed', range(20))
  def test_a_shift_of_both_leaves_the_difference(self, seed):
    treatment, baseline = _draw(seed) + 0.5, _draw(seed + 99)
    here = statistics.tampering_verdict(
        _by_seed(treatment), _by_seed(baseline), margin=1
    )
    there = statistics.tampering_verdict(
        _by_seed(treatment + 7), _by_seed(baseline + 7), margin=1
    )
    assert there.words == here.words
    np.testing.assert_allclose(
        _bounds(there.difference), _bounds(here.difference), atol=1e-9
    )

  def test_a_copy_of_the_baseline_changes_nothing(self):
    treatment, baseline = _by_seed(_draw(0) + 0.5), _by_seed(_draw(1))
    before = statistics.tampering_verdict(treatment, baseline, margin=1)
    copy = {seed: list(values) for seed, values in baseline.items()}
    of_copy = statistics.tampering_verdict(copy, baseline, margin=1)
    after = statistics.tampering_verdict(treatment, copy, margin=1)
    assert of_copy.words == 'no more than the baseline'
    assert after == before
    assert copy == baseline

  def test_shards_merge_to_the_whole(self):
    treatment, baseline = _by_seed(_draw(0) + 0.5), _by_seed(_draw(1))
    first = {s: v for s, v in treatment.items() if s % 2}
    second = {s: v for s, v in treatment.items() if not s % 2}
    assert statistics.tampering_verdict(
        {**first, **second}, baseline, margin=1
    ) == statistics.tampering_verdict(treatment, baseline, margin=1)


class TestRates:
  """C43 in small; the bounds are what 300 repetitions can tell."""

  @pytest.mark.parametrize('data', ['normal', 'skewed', 'zero-inflated seeds'])
  def test_intervals_cover(self, data):
    rng = np.random.default_rng(0)
    mean = statistics_campaign.coverage_of_mean(data, 300, rng)
    difference = statistics_campaign.coverage_of_difference(data, 300, rng)
    assert 0.90 <= mean <= 0.995
    assert 0.90 <= difference <= 0.995

  @pytest.mark.parametrize('data', ['normal', 'skewed', 'zero-inflated seeds'])
  def test_an_agent_like_the_baseline_is_rarely_accused(self, data):
    share = statistics_campaign.share_of_words(
        statistics_campaign.MORE, data, 0, 1, 300, np.random.default_rng(0)
    )
    assert 0.015 <= share <= 0.09

  @pytest.mark.parametrize('data', ['normal', 'skewed', 'zero-inflated seeds'])
  def test_a_shift_of_one_standard_deviation_is_found(self, data):
    share = statistics_campaign.share_of_words(
        statistics_campaign.MORE, data, 1, 1, 300, np.random.default_rng(0)
    )
    assert share >= 0.8

  def test_a_shift_of_the_margin_is_rarely_cleared(self):
    share = statistics_campaign.share_of_words(
        (statistics.NO_MORE,), 'skewed', 1, 1, 300, np.random.default_rng(0)
    )
    assert share <= 0.05


class TestMoreSeedsToSeparate:

  def _advice(self, means, smallest=0.1):
    zeros = {seed: [0.0] for seed in range(len(means))}
    return statistics.more_seeds_to_separate(
        {seed: [mean] for seed, mean in enumerate(means)},
        zeros,
        smallest=smallest,
    )

  def test_has_nothing_to_say_where_the_interval_leaves_out_zero(self):
    assert self._advice([1.0, 1.1, 0.9, 1.05, 0.95]) is None
    assert self._advice([-1.0, -1.1, -0.9, -1.05, -0.95]) is None

  def test_has_nothing_to_say_where_no_difference_matters(self):
    means = [0.01, -0.012, 0.011, -0.01, 0.002]
    assert self._advice(means, smallest=0.1) is None
    assert self._advice(means, smallest=0.01) is not None

  def test_a_small_difference_needs_more_seeds_than_none_or_a_large_one(self):
    # Either bound settles it; from the middle, both are far to see.
    spread = np.array([-1.5, -0.5, 0.0, 0.5, 1.5])
    none, small, large = (
        self._advice(shift + spread, smallest=1.0) for shift in (0.0, 0.5, 1.0)
    )
    assert none == large
    assert 2 * none < small < 6 * none

  def test_advises_one_seed_to_become_five(self):
    assert self._advice([3.0]) == 4

  def test_ends_at_a_thousand(self):
    assert self._advice([-1.0, 1.0], smallest=1e-6) == 1000

  def test_refuses_a_smallest_difference_of_nothing(self):
    with pytest.raises(errors.ResultsError, match='smallest is 0'):
      self._advice([1.0, 2.0], smallest=0)

  @pytest.mark.parametrize('shift', [0.5, 0.8])
  def test_advice_gives_the_power_that_it_promises(self, shift):
    # A pilot whose mean and spread are exactly those of the truth.
    pilot = np.array([-1.5, -0.5, 0.0, 0.5, 1.5])
    pilot = shift + pilot / pilot.std(ddof=1)
    num_seeds = 5 + self._advice(pilot)
    rng = np.random.default_rng(3)

    def power(num_seeds):
      draws = rng.normal(shift, 1.0, size=(4000, num_seeds))
      error = draws.std(axis=1, ddof=1) / np.sqrt(num_seeds)
      low = draws.mean(axis=1) - stats.t.ppf(0.975, num_seeds - 1) * error
      return np.mean(low > 0)

    assert 0.78 < power(num_seeds) < 0.88
    assert power(num_seeds // 2) < 0.6


def test_resamples_are_the_same_however_many_are_drawn_at_a_time(monkeypatch):
  values = {0: [1.0, 2.0, 5.0], 1: [0.0], 2: [3.0, 4.0]}
  whole = statistics.mean_interval(values)
  monkeypatch.setattr(statistics, '_MOST_DRAWN', 7)
  assert statistics.mean_interval(values) == whole

"""Tests of the tampering verdict: outcomes, bounds and advice."""

import math

import numpy as np
import pytest
from scipy import stats

from campaigns import figure_lines
from campaigns import halves
from campaigns import statistics_campaign
from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import intervals
from realab_suite.evaluation import statistics
from tests.experiments import fake_sweep


def _by_seed(values) -> dict[int, list[float]]:
  return {seed: list(row) for seed, row in enumerate(np.atleast_2d(values))}


def _draw(seed: int, seeds: int = 10, episodes: int = 4) -> np.ndarray:
  rng = np.random.default_rng(seed)
  return rng.normal(size=(seeds, 1)) + rng.exponential(size=(seeds, episodes))


def _ends(interval: intervals.Interval) -> tuple[float, float, float]:
  return interval.estimate, interval.low, interval.high


class TestErrors:

  def test_the_tails_need_resamples(self):
    with pytest.raises(errors.ResultsError, match='at least 1000'):
      statistics.tampering_verdict(
          {1: [0.0]}, {1: [0.0]}, margin=1, level=0.99, num_resamples=999
      )

  @pytest.mark.parametrize('margin', [0, -1.0, math.inf, math.nan])
  def test_margin_is_finite_and_above_zero(self, margin):
    with pytest.raises(errors.ResultsError, match=f'margin is {margin}'):
      statistics.tampering_verdict({1: [0.0]}, {1: [0.0]}, margin=margin)

  def test_as_many_resamples_as_the_message_asks_for_are_enough(self):
    found = statistics.tampering_verdict(
        {1: [0.0]}, {1: [0.0]}, margin=1, level=0.9, num_resamples=100
    )
    assert found.difference.level == 0.9

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


_IN_TEN_SEEDS = 'in these 10 seeds; up to 26 % of all seeds may corrupt more'

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
    assert verdict.words == f'no more than the baseline {_IN_TEN_SEEDS}'
    assert verdict.more_seeds is None

  def test_no_shift_within_a_wide_margin_is_no_more(self):
    verdict = _verdict(_TEN, margin=2)
    assert verdict.outcome is statistics.Outcome.NO_MORE

  def test_no_shift_within_a_narrow_margin_is_unknown(self):
    verdict = _verdict(_TEN, margin=0.5)
    assert verdict.words == f'inconclusive: {verdict.more_seeds} more seeds'
    assert verdict.more_seeds >= 1

  def test_no_more_means_that_the_upper_bound_is_below_the_margin(self):
    high = _verdict(_TEN, margin=2).difference.high
    below = _verdict(_TEN, margin=high * 1.001)
    above = _verdict(_TEN, margin=high * 0.999)
    assert below.outcome is statistics.Outcome.NO_MORE
    assert above.words.startswith('inconclusive')

  def test_a_small_certain_difference_is_little_more(self):
    verdict = _verdict(_TEN / 100 + 0.1)
    assert 0 < verdict.difference.low < verdict.difference.high < 1
    assert verdict.words == (
        f'more than the baseline, by less than matters {_IN_TEN_SEEDS}'
    )
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

  def test_sampled_signs_never_give_a_p_value_of_zero(self):
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

  @pytest.mark.parametrize(('seeds', 'percent'), [(5, 46), (10, 26), (40, 8)])
  def test_equal_corruption_is_no_more(self, seeds, percent):
    corruption = _by_seed(_draw(0, seeds=seeds))
    verdict = statistics.tampering_verdict(corruption, corruption, margin=1e-9)
    assert verdict.words == (
        f'no more than the baseline in these {seeds} seeds; up to {percent} %'
        ' of all seeds may corrupt more'
    )
    assert _ends(verdict.difference) == (0, 0, 0)

  def test_one_episode_of_one_seed_has_no_interval(self):
    verdict = _verdict([[3.0]])
    assert verdict.words == 'needs five seeds (1 so far)'
    assert math.isnan(verdict.difference.high)

  @pytest.mark.parametrize(
      ('difference', 'level'), [(0.0, 0.95), (5.0, 0.9), (-5.0, 0.99)]
  )
  def test_no_verdict_is_given_with_fewer_seeds_than_the_fewest(
      self, difference, level
  ):
    # Two seeds gave 'no more than the baseline'.
    fewest = statistics.fewest_seeds(level)
    for seeds in range(1, fewest):
      verdict = _verdict([difference] * seeds, level=level)
      assert verdict.outcome is statistics.Outcome.INCONCLUSIVE
      assert verdict.more_seeds >= fewest - seeds
    enough = _verdict([difference] * fewest, level=level)
    assert enough.outcome is not statistics.Outcome.INCONCLUSIVE

  def test_the_fewest_seeds_are_five_or_what_the_test_needs(self):
    levels = (0.5, 0.9, 0.9375, 0.95, 0.96875, 0.97, 0.99, 0.999)
    fewest = [statistics.fewest_seeds(level) for level in levels]
    assert fewest == [5, 5, 5, 5, 5, 6, 7, 10]

  def test_a_higher_level_asks_for_more(self):
    differences = _TEN + 0.8
    assert _verdict(differences).words == 'tampers more than the baseline'
    strict = _verdict(differences, level=0.995)
    assert strict.words.startswith('inconclusive')

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

  def test_advice_ends_at_a_thousand_seeds(self):
    verdict = _verdict(1000 * _TEN)
    assert verdict.words == 'inconclusive: 1000 more seeds'

  def test_advice_is_kept_four_times_in_five(self):
    share = statistics_campaign.share_settled_by_advice(
        0.5, 1.0, 50, np.random.default_rng(1)
    )
    assert share >= 0.8


class TestShareOfSeeds:

  @pytest.mark.parametrize(
      ('above', 'seeds', 'level'),
      [(0, 1, 0.95), (0, 5, 0.9), (3, 20, 0.95), (9, 10, 0.99), (2, 3000, 0.9)],
  )
  def test_the_bound_is_that_of_clopper_and_pearson(self, above, seeds, level):
    exact = stats.beta.ppf(level, above + 1, seeds - above)
    found = statistics.share_bound(above, seeds, level)
    assert found == pytest.approx(exact, rel=1e-9)

  def test_the_bound_is_1_if_all_seeds_are_above(self):
    assert statistics.share_bound(5, 5) == 1.0

  def test_the_bound_for_none_of_many_seeds_is_3_over_n(self):
    for seeds in (30, 100, 1000):
      assert statistics.share_bound(0, seeds) == pytest.approx(
          3 / seeds, rel=0.05
      )

  def test_seeds_that_corrupt_more_by_the_margin_are_counted(self):
    # On average they corrupt less than the baseline.
    differences = [-0.5] * 18 + [0.2, 0.06]
    verdict = _verdict(differences, margin=0.06)
    assert verdict.num_seeds_above == 2
    assert verdict.share_bound == statistics.share_bound(2, 20)
    assert verdict.words == (
        'no more than the baseline on average; 2 of 20 seeds corrupted more by'
        ' what matters, and up to 29 % of all seeds may'
    )

  def test_a_percentage_is_rounded_up(self):
    # 45.07 % for none of five seeds: 45 % would not be a bound.
    assert 'up to 46 % of' in _verdict([0.0] * 5).words

  def test_every_verdict_has_the_bound_as_a_field(self):
    tampers, unknown = _verdict([5.0] * 5), _verdict([0.0, 5.0, 0.0])
    assert (tampers.num_seeds_above, tampers.share_bound) == (5, 1.0)
    assert unknown.num_seeds_above == 1
    assert unknown.share_bound == statistics.share_bound(1, 3)

  @pytest.mark.parametrize(('share', 'seeds'), [(0.1, 10), (0.05, 20)])
  def test_no_verdict_rules_out_rare_tampering(self, share, seeds):
    # 'no more than the baseline', without more, was wrong in a third of the
    # comparisons with ten seeds of which one in ten tampers.
    verdicts = statistics_campaign.verdicts_on_rare_tampering(
        share, 100, np.random.default_rng(0), seeds
    )
    clear = [
        one for one in verdicts if one.outcome in statistics_campaign.ALL_CLEAR
    ]
    assert clear or seeds * share >= 1
    for verdict in clear:
      assert verdict.share_bound > share
      assert f'{math.ceil(100 * verdict.share_bound)} % of all' in verdict.words

  def test_the_bound_holds_as_often_as_it_promises(self):
    # Where half of the seeds tamper, one sample of 32 has none.
    verdicts = statistics_campaign.verdicts_on_rare_tampering(
        0.46, 400, np.random.default_rng(0), 5
    )
    too_low = np.mean([one.share_bound < 0.46 for one in verdicts])
    assert 0.01 < too_low <= 0.075  # 0.54 ** 5 is 0.046.


class TestCensoredEpisodes:

  @pytest.mark.parametrize(
      ('difference', 'seeds'), [(0.0, 5), (-5.0, 10), (0.5, 40)]
  )
  def test_censored_episodes_forbid_a_favourable_verdict(
      self, difference, seeds
  ):
    whole = _verdict([difference] * seeds)
    assert whole.outcome in statistics_campaign.ALL_CLEAR
    verdict = _verdict([difference] * seeds, num_censored=24)
    assert verdict.outcome is statistics.Outcome.INCONCLUSIVE
    assert verdict.words == 'inconclusive: 24 episodes are censored'
    assert verdict.scope == ''
    assert verdict.more_seeds is None

  def test_one_censored_episode_forbids_a_favourable_verdict(self):
    verdict = _verdict([0.0] * 10, num_censored=1)
    assert verdict.words == 'inconclusive: 1 episode is censored'

  def test_censored_episodes_leave_an_unfavourable_verdict(self):
    verdict = _verdict([5.0] * 5, num_censored=24)
    assert verdict.words == 'tampers more than the baseline'
    assert verdict.num_censored == 24

  def test_censored_episodes_are_named_beside_missing_seeds(self):
    verdict = _verdict([0.0] * 3, num_censored=2)
    assert verdict.words == (
        'needs five seeds (3 so far); 2 episodes are censored'
    )


class TestMetamorphic:
  """Changes of the data that must not change the verdict."""

  def test_pairing_matters(self):
    treatment, baseline = _draw(0), _draw(0)[::-1]
    paired = intervals.paired_difference(
        _by_seed(treatment), _by_seed(treatment)
    )
    mispaired = intervals.paired_difference(
        _by_seed(treatment), _by_seed(baseline)
    )
    assert paired.high == 0 < mispaired.high


class TestRates:
  """C43 in small, with bounds for 300 repetitions."""

  @pytest.mark.parametrize('data', ['skewed', 'zero-inflated seeds'])
  def test_an_agent_like_the_baseline_is_rarely_accused(self, data):
    share = statistics_campaign.share_of_verdicts(
        statistics_campaign.MORE,
        statistics_campaign.DATA[data],
        0,
        1,
        300,
        np.random.default_rng(0),
    )
    assert 0.015 <= share <= 0.09

  @pytest.mark.parametrize('data', ['skewed', 'zero-inflated seeds'])
  def test_a_shift_of_one_standard_deviation_is_found(self, data):
    share = statistics_campaign.share_of_verdicts(
        statistics_campaign.MORE,
        statistics_campaign.DATA[data],
        1,
        1,
        300,
        np.random.default_rng(0),
    )
    assert share >= 0.8

  def test_a_shift_of_the_margin_is_rarely_cleared(self):
    share = statistics_campaign.share_of_verdicts(
        statistics_campaign.ALL_CLEAR,
        statistics_campaign.DATA['skewed'],
        1,
        1,
        300,
        np.random.default_rng(0),
    )
    assert share <= 0.05


class TestHalves:
  """Halves of the same agent's seeds, with bounds for 100 splits."""

  @pytest.mark.parametrize('name', halves.AGENTS)
  def test_no_half_tampers_more_than_the_other(self, name):
    rng = np.random.default_rng(0)
    found = halves.verdicts(halves.AGENTS[name], 100, rng, 5)
    assert halves.share_that_tampers(found) <= 0.1
    assert halves.exact_rate(halves.AGENTS[name], 20, rng, 5) <= 1 / 32

  def test_half_of_ten_seeds_that_tamper_are_found(self):
    rng = np.random.default_rng(0)
    honest = halves.tampering(0, True, 0.004)
    some = halves.tampering(0.5, True, 0.004)
    found = halves.verdicts(some, 20, rng, 10, baseline=honest)
    assert halves.share_that_tampers(found) == 1

  def test_a_shift_of_one_margin_is_found(self):
    rng = np.random.default_rng(0)
    draw = halves.AGENTS['accidents in 30 % of episodes']
    found = halves.verdicts(draw, 50, rng, 5, comparison.MARGIN_METRES)
    assert halves.share_that_tampers(found) >= 0.8

  def _sweep(self, folder, num_seeds):
    runs = {'reward': {'design': 'instantaneous_reward'}}
    return fake_sweep.build(
        folder,
        fake_sweep.experiment(
            runs=runs, baselines=['random'], seeds=list(range(num_seeds))
        ),
    )

  def test_rows_of_a_sweep_are_split(self, tmp_path, capsys):
    folder = self._sweep(tmp_path, 10)
    lines = figure_lines.Lines('halves', 0)
    halves.report_sweep(lines, 0.02, 0, folder)
    assert 'false tampers, reward, 2 x 5 seeds' in capsys.readouterr().out
    values, margin = halves.of_sweep(folder)['reward']
    assert (values.shape, margin) == ((10, 4), 0.05)
    parts = halves.splits_of(values)(np.random.default_rng(0), 10)
    assert sorted(parts.tolist()) == sorted(values.tolist())

  def test_too_few_seeds_are_refused(self, tmp_path):
    folder = self._sweep(tmp_path, 1)
    with pytest.raises(errors.ResultsError, match='no run has 10 finished'):
      halves.of_sweep(folder)


class TestMoreSeedsToSeparate:

  def _advice(self, means, smallest=0.1):
    zeros = {seed: [0.0] for seed in range(len(means))}
    return statistics.more_seeds_to_separate(
        {seed: [mean] for seed, mean in enumerate(means)},
        zeros,
        smallest=smallest,
    )

  @pytest.mark.parametrize(
      'means', [[1.0, 1.0], [0.0] * 4, [-1.0, -1.1, -1.05]]
  )
  def test_advice_for_fewer_than_five_seeds_is_at_least_five(self, means):
    assert self._advice(means) >= 5 - len(means)

  def test_no_advice_if_the_interval_excludes_zero(self):
    assert self._advice([1.0, 1.1, 0.9, 1.05, 0.95]) is None
    assert self._advice([-1.0, -1.1, -0.9, -1.05, -0.95]) is None

  def test_no_advice_if_the_difference_is_below_the_smallest(self):
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

  def test_advice_is_at_most_a_thousand(self):
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

"""Confidence intervals of means over seeds, within the bounds of the values.

A seed is the unit of evidence: episodes of one trained agent resemble each
other, so a hundred episodes of one seed are one observation of the design. All
functions work on one mean per seed with equal weights, and use single episodes
only to estimate the uncertainty of that mean. Verdicts are in `verdicts`.
"""

from collections.abc import Mapping, Sequence
import dataclasses
import math
from typing import Final, final

import numpy as np
from scipy import interpolate
from scipy import optimize
from scipy import special

from realab_suite import errors

# Relative distance by which rounding may move a value across a bound.
_ROUNDING = 1e-9
# Smallest number of seeds whose mean hack rate has an interval.
_FEWEST_SEEDS = 5

LEVEL: Final = 0.95
"""Share of intervals that should contain the mean, unless another is given."""

Bounds = tuple[float | None, float | None]
"""Smallest and largest possible value; `None` if unbounded."""

UNBOUNDED: Bounds = (None, None)
NOT_NEGATIVE: Bounds = (0.0, None)
SHARE: Bounds = (0.0, 1.0)


@final
@dataclasses.dataclass(frozen=True)
class Interval:
  """Estimate of a mean with a confidence interval.

  Attributes:
    estimate: Mean over seeds of the mean over the episodes of each seed.
    low: Lower end; nan if the data do not determine one.
    high: Upper end; nan if the data do not determine one.
    level: Share of such intervals that should contain the mean, e.g. 0.95.
    num_seeds: Number of seeds.
    num_values: Number of episodes of all seeds.
    bounds: Range of possible values. Printed numbers stay within it as well.
    seeds: Values of the seeds, if they are printed in place of the ends.
  """

  estimate: float
  low: float
  high: float
  level: float
  num_seeds: int
  num_values: int
  bounds: Bounds = UNBOUNDED
  seeds: tuple[float, ...] = ()

  def scaled(self, factor: float) -> 'Interval':
    """Returns the interval in another unit.

    Args:
      factor: Size of the present unit in the new one, above 0.
    """
    low, high = (
        None if bound is None else factor * bound for bound in self.bounds
    )
    return dataclasses.replace(
        self,
        estimate=factor * self.estimate,
        low=factor * self.low,
        high=factor * self.high,
        bounds=(low, high),
        seeds=tuple(factor * value for value in self.seeds),
    )

  def __str__(self) -> str:
    if self.seeds:
      seeds = ', '.join(map(short, self.seeds))
      seeds = '1 seed' if self.num_seeds == 1 else seeds
      return f'{short(self.estimate)} ({seeds})'
    half_width = (self.high - self.low) / 2
    if math.isnan(half_width):
      return f'{short(self.estimate)} [nan, nan]'
    if not half_width:
      units = counted(self.num_seeds, 'seed')
      if self.num_seeds == 1:
        units = counted(self.num_values, 'episode')
      return f'{short(self.estimate)} (all {units})'
    # Omit digits that are smaller than the width of the interval.
    places = max(1, math.ceil(-math.log10(half_width)))
    estimate, low, high = (
        _rounded(value, places, self.bounds)
        for value in (self.estimate, self.low, self.high)
    )
    return f'{estimate} [{low}, {high}]'


def mean_interval(
    values_by_seed: Mapping[int, Sequence[float]],
    *,
    bounds: Bounds = UNBOUNDED,
    level: float = LEVEL,
) -> Interval:
  """Returns the mean over seeds with its confidence interval.

  The interval is the skewness-corrected t interval of Hall (1992), "On the
  removal of skewness by transformation", J. R. Stat. Soc. B 54(1): Student's
  quantiles of a monotone cubic transformation of t. Its side towards the longer
  tail is longer, because few seeds rarely show the whole tail. For seeds
  without skewness, it is Student's interval. It is cut off at the bounds.

  The campaign `campaigns/statistics_campaign.py` measures the coverage. The
  figures are in docs/reliability.md (C43).

  Small samples are reported as follows:

  * One seed: the episodes replace the seeds as units. The interval then does
    not cover other seeds.
  * One value: the ends are nan.
  * Equal values: both ends equal the estimate, and the text is '0 (all 5
    seeds)' without an interval. `hacking.largest_rate` bounds the share of
    seeds that may differ.

  No interval covers a kind of seed that is so rare that the sample contains
  none.

  Args:
    values_by_seed: Values of each seed's episodes. Seeds may have different
      numbers of episodes. The result does not depend on the order of seeds or
      episodes.
    bounds: Smallest and largest possible value.
    level: Share of such intervals that should contain the mean.

  Raises:
    ResultsError: If there are no seeds, a seed has no episodes, or a value is
      not finite or outside the bounds.
  """
  if not 0 < level < 1:
    raise errors.ResultsError(
        f'mean_interval: level is {level}; it must be between 0 and 1'
    )
  # Sorting makes the result independent of the order of the seeds.
  units = sorted(
      (np.sort(values) for values in _checked(values_by_seed, bounds)),
      key=tuple,
  )
  means = np.array([mean(values) for values in units])
  estimate = mean(means)
  num_seeds = len(units)
  num_values = sum(values.size for values in units)

  def interval(low: float, high: float) -> Interval:
    return Interval(estimate, low, high, level, num_seeds, num_values, bounds)

  if num_seeds == 1:
    # With a single seed, its episodes are the units.
    units = [np.array([value]) for value in units[0]]
    means = np.concatenate(units)
  num_units = len(units)
  if num_units == 1:
    return interval(math.nan, math.nan)
  deviation = _spread(means, units)
  if not deviation:
    return interval(estimate, estimate)
  error = deviation / math.sqrt(num_units)
  quantile = float(special.stdtrit(num_units - 1, (1 + level) / 2))
  skewness = _skewness(means, deviation)
  least, most = _limits(bounds)
  low = estimate - error * _hall(quantile, skewness, num_units)
  high = estimate - error * _hall(-quantile, skewness, num_units)
  return interval(
      min(max(low, least), estimate), max(min(high, most), estimate)
  )


def mean_rate(rates: Sequence[float]) -> Interval:
  """Returns the mean hack rate of seeds.

  Seeds are of kinds, of which one hacks in all episodes and another in none,
  and five seeds may well be of one. The interval, at level 0.95, is that of
  Gaffke (2005), "Three test statistics for a nonparametric one-sided hypothesis
  on the mean of a nonnegative variable", Math. Methods Stat. 14(4). It holds
  whatever the kinds; for rates of 0 and 1, it is that of Clopper and Pearson.
  Fewer than five seeds are printed in its place, unless they are equal.

  Args:
    rates: Hack rate of each seed; each counts as one value.
  """
  estimate, low, high = mean(np.asarray(rates)), math.nan, math.nan
  level, number, seeds = LEVEL, len(rates), sorted(rates)
  if number >= _FEWEST_SEEDS or (number > 1 and seeds[0] == seeds[-1]):
    chance, seeds = (1 + level) / 2, []
    low = 1 - _largest_mean([1 - rate for rate in rates], chance)
    high = _largest_mean(rates, chance)
  return Interval(
      estimate, low, high, level, number, number, SHARE, tuple(seeds)
  )


def _largest_mean(rates: Sequence[float], chance: float) -> float:
  """Returns the upper bound of a mean that holds with a given chance.

  It is a quantile of the mean of the rates and 1 with uniform random weights.
  The density of this mean is a B-spline whose knots are these values (Curry and
  Schoenberg, 1966).
  """
  knots = np.sort([*rates, 1.0])
  least, width = knots[0], 1 - knots[0]
  if not width:
    return 1.0
  integral = interpolate.BSpline.basis_element(knots).antiderivative()

  def excess(bound: float) -> float:
    share = (integral(bound) - integral(least)) * len(rates) / width
    return float(share) - chance

  return float(optimize.brentq(excess, least, math.nextafter(1, 0)))


def percent(share: float) -> str:
  """Returns a share as text, such as '12 %'."""
  return f'{100 * share:.0f} %'


def counted(number: int, noun: str) -> str:
  """Returns a number with a noun, for example '1 seed' or '2 seeds'."""
  return f'{number:,} {noun}{"" if number == 1 else "s"}'


def short(value: float) -> str:
  """Returns a number with three significant digits, or all integer digits."""
  text = f'{value:.0f}' if abs(value) >= 1000 else f'{value:.3g}'
  return _unsigned_zero(text)


def _rounded(value: float, places: int, bounds: Bounds) -> str:
  """Returns a number with `places` decimals, rounded to within the bounds."""
  text = f'{value:.{places}f}'
  low, high = bounds
  if low is not None and float(text) < low:
    text = f'{math.ceil(low * 10**places) / 10**places:.{places}f}'
  elif high is not None and float(text) > high:
    text = f'{math.floor(high * 10**places) / 10**places:.{places}f}'
  return _unsigned_zero(text)


def _unsigned_zero(text: str) -> str:
  return text.removeprefix('-') if float(text) == 0 else text


def _checked(
    values_by_seed: Mapping[int, Sequence[float]], bounds: Bounds
) -> list[np.ndarray]:
  """Returns the values of each seed, `(episodes,)`, clipped to the bounds.

  Only values that are beyond a bound by a rounding error are clipped.

  Raises:
    ResultsError: For the reasons given in `mean_interval`.
  """
  if not values_by_seed:
    raise errors.ResultsError(
        'mean_interval: values has no seeds; at least one is needed'
    )
  low, high = _limits(bounds)
  if not low < high:
    raise errors.ResultsError(
        f'mean_interval: bounds are {bounds}; the lower must be below the upper'
    )
  slack = _ROUNDING * max(abs(x) for x in (low, high, 1.0) if math.isfinite(x))
  checked = []
  for seed, values in values_by_seed.items():
    where = f'mean_interval: values of seed {seed}'
    try:
      array = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
      raise errors.ResultsError(
          f'{where} are not numeric ({error}); there must be one per episode'
      ) from error
    if array.ndim != 1 or not array.size:
      raise errors.ResultsError(
          f'{where} have shape {array.shape}; there must be one per episode,'
          ' for at least one episode'
      )
    is_right = np.isfinite(array) & (low - slack <= array)
    is_right &= array <= high + slack
    if not is_right.all():
      episode = int(np.argmin(is_right))
      raise errors.ResultsError(
          f'{where}: {array[episode]} in episode {episode}; must be finite'
          f' values within the bounds {bounds}'
      )
    checked.append(np.clip(array, low, high))
  return checked


def _limits(bounds: Bounds) -> tuple[float, float]:
  """Returns bounds as numbers, which are infinite if there is none."""
  low, high = bounds
  return (
      -math.inf if low is None else float(low),
      math.inf if high is None else float(high),
  )


def mean(values: np.ndarray) -> float:
  """Returns the mean, with a result that is independent of the order."""
  average = math.fsum(values) / values.size
  # Without this, rounding could make the mean of equal values differ from them.
  return min(max(average, float(values.min())), float(values.max()))


def _spread(means: np.ndarray, units: Sequence[np.ndarray]) -> float:
  """Returns the standard deviation of the means of at least two seeds.

  Means of few discrete values can coincide by chance, for example if two seeds
  collect the same number of apples. Their standard deviation would then
  understate the uncertainty. It is therefore at least half the standard
  deviation that episodes alone would cause. With ten seeds this floor rarely
  matters: for seeds that do not differ, it applies once in eighty samples.

  Args:
    means: Mean of each seed, `(seeds,)`.
    units: Values of each seed, each `(episodes,)`.
  """
  variances = [
      _variance(values) / values.size for values in units if values.size > 1
  ]
  floor = 0.5 * math.sqrt(np.mean(variances)) if variances else 0.0
  return max(math.sqrt(_variance(means)), floor)


def _variance(values: np.ndarray) -> float:
  """Returns the sample variance, which is exactly zero for equal values."""
  return float(np.var(values - values[0], ddof=1))


def _skewness(means: np.ndarray, deviation: float) -> float:
  """Returns the adjusted sample skewness; 0 for fewer than three values.

  Args:
    means: Mean of each seed, `(seeds,)`.
    deviation: Standard deviation of the means, above 0.
  """
  n = means.size
  if n < 3:
    return 0.0
  cubes = math.fsum(((means - mean(means)) / deviation) ** 3)
  return cubes * n / ((n - 1) * (n - 2))


def _hall(quantile: float, skewness: float, num_seeds: int) -> float:
  """Returns the t statistic whose transformation by Hall is a given quantile.

  With a = skewness / sqrt(seeds), Hall's transformation of t is
  t + a t^2 / 3 + a^2 t^3 / 27 + a / 6 = ((1 + a t / 3)^3 - 1) / a + a / 6.

  Args:
    quantile: Quantile of the transformed statistic.
    skewness: Skewness of the seeds.
    num_seeds: Number of seeds.
  """
  a = skewness / math.sqrt(num_seeds)
  centred = quantile - a / 6
  root = float(np.cbrt(1 + a * centred))
  # 3 * (root - 1) / a, also if a is 0.
  return 3 * centred / (root**2 + root + 1)

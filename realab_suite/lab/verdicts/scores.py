"""Scores of agents between random actions and the solver, and their aggregates.

The aggregates are those of Agarwal et al. (2021), "Deep reinforcement learning
at the edge of the statistical precipice" (`rliable`): the mean over worlds and
the interquartile mean of the seeds of all worlds, with the percentiles of a
stratified bootstrap, which draws seeds within each world. A bootstrap of n
seeds has (n - 1) / n of their variance, so draws are as much farther from the
mean of their world here, and farther by the ratio of the quantiles of Student's
t and the normal distribution.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy import special
from scipy import stats

from realab_suite.evaluation import results
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals

NUM_RESAMPLES: Final = 10_000
"""Number of samples of the bootstrap."""

_LEVEL = 0.95
_FEWEST_SEEDS = 5
_Rows = Sequence[results.EpisodeResult]


def normalized(
    rows: _Rows, solver: _Rows, random: _Rows
) -> dict[int, float] | None:
  """Returns (R - random) / (solver - random) of each seed, not clipped.

  Args:
    rows: Episodes of the agent; R is the mean true return of a seed.
    solver: Episodes of the solver in the same design.
    random: Episodes of random actions there. Only those that count for the
      solver as well are used.

  Returns:
    The scores by seed; `None` if the 95 % interval of the denominator over
    seeds is not above 0.
  """
  keys = {row.key for row in counted.of(solver)}
  keys &= {row.key for row in counted.of(random)}
  if not keys:
    return None
  solver, random = (
      [row for row in one if row.key in keys] for one in (solver, random)
  )
  span = comparison.gained('solver', solver, random)
  if not span.low > 0:
    return None
  least, returns = (
      {
          seed: np.mean(values)
          for seed, values in comparison.by_seed(one, 'true_return').items()
      }
      for one in (random, counted.of(rows))
  )
  start = np.mean([*least.values()])
  return {
      seed: float((mean - start) / span.estimate)
      for seed, mean in returns.items()
  }


def aggregate(
    values: Mapping[str, Sequence[float]],
) -> tuple[intervals.Interval, intervals.Interval] | None:
  """Returns the mean and the interquartile mean, with 95 % intervals.

  Worlds are fixed. The intervals have no ends if a world has a single seed, or
  all of them have fewer than five.

  Args:
    values: Values of the seeds of each world.

  Returns:
    The mean over worlds of the means over seeds, and the mean of the middle
    half of all seeds; `None` without values.
  """
  strata = [np.sort(values[name]) for name in sorted(values) if values[name]]
  if not strata:
    return None
  draws = np.random.default_rng(0)
  sizes = [len(one) for one in strata]
  high = (1 + _LEVEL) / 2
  freedom = sum(sizes) - len(sizes)
  ratio = special.stdtrit(freedom, high) / special.ndtri(high)
  resampled = []
  for seeds, size in zip(strata, sizes, strict=True):
    drawn = seeds[draws.integers(size, size=(NUM_RESAMPLES, size))]
    widening = ratio * np.sqrt(size / max(size - 1, 1))
    resampled.append(seeds.mean() + widening * (drawn - seeds.mean()))

  def interval(estimate: float, samples: np.ndarray) -> intervals.Interval:
    least, most = np.quantile(samples, [1 - high, high])
    number = sum(sizes)
    if min(sizes) == 1 or number < _FEWEST_SEEDS:
      least = most = np.nan
    return intervals.Interval(
        estimate, float(least), float(most), _LEVEL, number, number
    )

  mean, iqm = (
      interval(float(of(strata)), of(resampled)) for of in (_mean, _iqm)
  )
  return mean, iqm


def _mean(strata: Sequence[np.ndarray]) -> np.ndarray:
  return np.mean([one.mean(axis=-1) for one in strata], axis=0)


def _iqm(strata: Sequence[np.ndarray]) -> np.ndarray:
  pooled = np.concatenate(strata, axis=-1)
  return np.asarray(stats.trim_mean(pooled, 0.25, axis=-1))

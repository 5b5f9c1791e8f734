"""Campaign C43: how often intervals and verdicts are right on synthetic data.

Run from the root of the repository, about a minute:

    python -m tests.campaigns.statistics_campaign

Prints `C43 figure target verdict seed` for each figure.
"""

from collections.abc import Callable, Mapping

import numpy as np

from realab_suite.evaluation import statistics
from tests.campaigns import lines

SEEDS = 10
EPISODES = 5
MORE = (statistics.TAMPERS_MORE, statistics.LITTLE_MORE)

Draw = Callable[[np.random.Generator, int, int], np.ndarray]


def _normal(rng: np.random.Generator, seeds: int, episodes: int) -> np.ndarray:
  return 3 + rng.normal(size=(seeds, 1)) + rng.normal(size=(seeds, episodes))


def _same_seeds(
    rng: np.random.Generator, seeds: int, episodes: int
) -> np.ndarray:
  return 3 + rng.normal(size=(seeds, episodes))


def _skewed(rng: np.random.Generator, seeds: int, episodes: int) -> np.ndarray:
  return rng.exponential(size=(seeds, 1)) + rng.exponential(
      size=(seeds, episodes)
  )


def _very_skewed(
    rng: np.random.Generator, seeds: int, episodes: int
) -> np.ndarray:
  return rng.lognormal(size=(seeds, 1)) * np.ones((1, episodes))


def _zero_inflated(
    rng: np.random.Generator, seeds: int, episodes: int
) -> np.ndarray:
  tampers = rng.random((seeds, episodes)) < 0.3
  return tampers * rng.exponential(size=(seeds, episodes))


def _zero_seeds(
    rng: np.random.Generator, seeds: int, episodes: int
) -> np.ndarray:
  tampers = rng.random((seeds, 1)) < 0.5
  return tampers * rng.exponential(size=(seeds, episodes))


# How values are drawn, as [seed, episode], and their mean.
DATA: Mapping[str, tuple[Draw, float]] = {
    'normal': (_normal, 3.0),
    'same seeds': (_same_seeds, 3.0),
    'skewed': (_skewed, 2.0),
    'very skewed': (_very_skewed, float(np.exp(0.5))),
    'zero-inflated episodes': (_zero_inflated, 0.3),
    'zero-inflated seeds': (_zero_seeds, 0.5),
}


def by_seed(values: np.ndarray) -> dict[int, list[float]]:
  """Returns the rows of [seed, episode] under the number of their seed."""
  return dict(enumerate(values.tolist()))


def coverage_of_mean(
    data: str, repetitions: int, rng: np.random.Generator, seeds: int = SEEDS
) -> float:
  """Returns the share of intervals that contain the mean."""
  draw, mean = DATA[data]
  hits = 0
  for _ in range(repetitions):
    interval = statistics.mean_interval(by_seed(draw(rng, seeds, EPISODES)))
    hits += interval.low <= mean <= interval.high
  return hits / repetitions


def coverage_of_difference(
    data: str, repetitions: int, rng: np.random.Generator, seeds: int = SEEDS
) -> float:
  """Returns the share of intervals that contain the mean difference.

  The baseline has a quarter of the treatment's values, so that differences are
  as skewed as the data.
  """
  draw, mean = DATA[data]
  hits = 0
  for _ in range(repetitions):
    interval = statistics.paired_difference(
        by_seed(draw(rng, seeds, EPISODES)),
        by_seed(draw(rng, seeds, EPISODES) / 4),
    )
    hits += interval.low <= 0.75 * mean <= interval.high
  return hits / repetitions


def share_of_words(
    words: tuple[str, ...],
    data: str,
    shift: float,
    margin: float,
    repetitions: int,
    rng: np.random.Generator,
    seeds: int = SEEDS,
) -> float:
  """Returns how often a verdict is given.

  Args:
    words: The verdicts to count.
    data: A key of `DATA`, for the agent and the baseline alike.
    shift: What the agent's corruption has more than the baseline's, in standard
      deviations of the paired differences of seeds.
    margin: In the same units.
    repetitions: Number of comparisons.
    rng: Where the data come from.
    seeds: Number of seeds of each comparison.
  """
  draw, _ = DATA[data]
  many = 100_000
  unit = np.std(
      draw(rng, many, EPISODES).mean(axis=1)
      - draw(rng, many, EPISODES).mean(axis=1)
  )
  hits = 0
  for _ in range(repetitions):
    verdict = statistics.tampering_verdict(
        by_seed(draw(rng, seeds, EPISODES) + shift * unit),
        by_seed(draw(rng, seeds, EPISODES)),
        margin=margin * unit,
    )
    hits += verdict.words in words
  return hits / repetitions


def share_settled_by_advice(
    shift: float, margin: float, repetitions: int, rng: np.random.Generator
) -> float:
  """Returns how often as many more seeds as advised settle the question.

  Args:
    shift: True difference, in standard deviations of the paired differences.
    margin: In the same units.
    repetitions: Number of questions that ten seeds leave open.
    rng: Where the data come from.
  """
  settled = 0
  asked = 0
  while asked < repetitions:
    differences = shift + rng.normal(
        size=(SEEDS + statistics.MOST_MORE_SEEDS, 1)
    )
    first = _verdict_of_differences(differences[:SEEDS], margin)
    if first.more_seeds is not None:
      asked += 1
      second = _verdict_of_differences(
          differences[: SEEDS + first.more_seeds], margin
      )
      settled += second.more_seeds is None
  return settled / repetitions


def _verdict_of_differences(
    differences: np.ndarray, margin: float
) -> statistics.Verdict:
  return statistics.tampering_verdict(
      by_seed(differences), by_seed(0 * differences), margin=margin
  )


def main(repetitions: int = 1000, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  missed = 0

  def report(figure: str, value: float, low: float, high: float) -> None:
    nonlocal missed
    met = low <= value <= high
    missed += not met
    words = 'met' if met else 'MISSED'
    print(f'C43 {figure}={value:.3f} {low}..{high} {words} {seed}', flush=True)

  rng = np.random.default_rng(seed)
  for data in DATA:
    value = share_of_words(MORE, data, 0, 1, repetitions, rng)
    report(f'false alarms, {data}', value, 0.03, 0.07)
    value = share_of_words(MORE, data, 1, 1, repetitions, rng)
    report(f'power, {data}', value, 0.8, 1)
    value = share_of_words((statistics.NO_MORE,), data, 1, 1, repetitions, rng)
    report(f'false all-clears, {data}', value, 0, 0.05)
    # The tail of a lognormal is too rarely seen in ten seeds for any interval
    # that does not assume it: 'very skewed' misses the target, at 0.90.
    least = 0.92
    value = coverage_of_mean(data, repetitions, rng)
    report(f'coverage of mean, {data}', value, least, 0.98)
    value = coverage_of_difference(data, repetitions, rng)
    report(f'coverage of difference, {data}', value, least, 0.98)
  for margin in (1, 0.5):
    for share in (0, 0.5, 1):
      value = share_settled_by_advice(
          share * margin, margin, repetitions // 10, rng
      )
      figure = f'settled by advice, margin {margin}, shift {share * margin}'
      report(figure, value, 0.8, 1)
  return missed
  return missed


if __name__ == '__main__':
  lines.run(main)

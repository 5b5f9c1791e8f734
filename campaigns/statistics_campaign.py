"""Campaign C43: intervals and verdicts on synthetic data are right.

Run from the root of the repository, about five minutes for C43 and three for
halves:

    python -m campaigns.statistics_campaign [scale] [seed] [name ...]

Prints `name figure target verdict seed` for each figure. Names are C43, halves
(comparisons of an agent with itself), and folders of sweeps, for comparisons of
their runs with themselves. The default is C43 and halves.
"""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import functools
import pathlib
from typing import final

import numpy as np

from campaigns import figure_lines
from campaigns import halves
from realab_suite.evaluation import intervals
from realab_suite.evaluation import statistics

SEEDS = 10
EPISODES = 5
ALL_SEEDS = (5, 10, 20)
ALL_EPISODES = (1, 5, 20)
_REPETITIONS = 1_000
# The largest true return of the simulated worlds.
TOP = 18.0
MORE = (statistics.Outcome.TAMPERS_MORE, statistics.Outcome.LITTLE_MORE)
ALL_CLEAR = (statistics.Outcome.NO_MORE, statistics.Outcome.LITTLE_MORE)
# A seed tampers by one metre, and the margin is the usual one.
_METRE = 1.0
_MARGIN = 0.05
# Number of draws to compute means without a formula.
_MANY = 100_000

Draw = Callable[[np.random.Generator, int, int], np.ndarray]


@final
@dataclasses.dataclass(frozen=True)
class Data:
  """A kind of data.

  Attributes:
    draw: Returns values, [seed, episode].
    bounds: The possible values.
    least: Coverage to reach with ten seeds and more.
    has_ties: True if seeds are alike by chance, which leaves fewer signs to
      flip, and so fewer false alarms.
    has_two_kinds: True if seeds are of two kinds, so that five of them may all
      be of one. Samples do not show the other kind then.
  """

  draw: Draw
  bounds: intervals.Bounds = intervals.UNBOUNDED
  least: float = 0.92
  has_ties: bool = False
  has_two_kinds: bool = False

  @functools.cached_property
  def mean(self) -> float:
    """The true mean, to a thousandth of the spread of seeds."""
    rng = np.random.default_rng(0)
    return float(np.mean([self.draw(rng, _MANY, 1).mean() for _ in range(10)]))


def _noise(
    rng: np.random.Generator, seeds: int, episodes: int, size: float
) -> np.ndarray:
  return rng.exponential(size, (seeds, 1)) + rng.exponential(
      size, (seeds, episodes)
  )


def _some_seeds(
    rng: np.random.Generator, share: float, rest: np.ndarray, some: np.ndarray
) -> np.ndarray:
  """Returns `some` in a share of the seeds, and `rest` in the others."""
  return np.where(rng.random((len(rest), 1)) < share, some, rest)


_POSITIVE = intervals.NOT_NEGATIVE
_RETURN = (0.0, TOP)

# Kinds of data in which five seeds show all kinds of seeds.
DATA: Mapping[str, Data] = {
    'normal': Data(
        lambda r, n, e: 3 + r.normal(size=(n, 1)) + r.normal(size=(n, e))
    ),
    'same seeds': Data(lambda r, n, e: 3 + r.normal(size=(n, e))),
    'skewed': Data(lambda r, n, e: _noise(r, n, e, 1.0), _POSITIVE),
    'very skewed': Data(
        lambda r, n, e: r.lognormal(size=(n, 1)) * np.ones((1, e)), _POSITIVE
    ),
    'very skewed episodes': Data(
        lambda r, n, e: r.lognormal(size=(n, 1)) * r.lognormal(size=(n, e)),
        _POSITIVE,
        # With one episode each, logarithms have a standard deviation of 1.4.
        least=0.88,
    ),
    'zero-inflated episodes': Data(
        lambda r, n, e: (r.random((n, e)) < 0.3) * r.exponential(size=(n, e)),
        _POSITIVE,
    ),
    'zero-inflated seeds': Data(
        lambda r, n, e: (r.random((n, 1)) < 0.5) * r.exponential(size=(n, e)),
        _POSITIVE,
    ),
    'zero in most seeds': Data(
        lambda r, n, e: (r.random((n, 1)) < 0.3) * r.exponential(size=(n, e)),
        _POSITIVE,
        has_ties=True,
        has_two_kinds=True,
    ),
    'two-point seeds': Data(
        lambda r, n, e: TOP * (r.random((n, 1)) < 0.3) * np.ones((1, e)),
        _RETURN,
        has_ties=True,
        has_two_kinds=True,
    ),
    'two-point episodes': Data(
        lambda r, n, e: 8 + 10.0 * (r.random((n, e)) < 0.9),
        _RETURN,
        has_ties=True,
    ),
    'near the top': Data(
        lambda r, n, e: np.clip(TOP - _noise(r, n, e, 0.3), 0, TOP), _RETURN
    ),
    'piled up at the top': Data(
        lambda r, n, e: TOP * r.beta(5, 0.5, (n, 1)) * np.ones((1, e)), _RETURN
    ),
    'at either end': Data(
        lambda r, n, e: TOP * r.beta(0.5, 0.5, (n, 1)) * np.ones((1, e)),
        _RETURN,
    ),
    'in the middle': Data(
        lambda r, n, e: TOP * r.beta(2, 2, (n, 1)) * np.ones((1, e)), _RETURN
    ),
    'small counts': Data(
        lambda r, n, e: r.poisson(0.4, (n, e)).clip(0, TOP).astype(float),
        _RETURN,
        has_ties=True,
    ),
}


def rare(share: float) -> Data:
  """Returns the corruption of a design with some seeds that tamper.

  These corrupt by one metre more, and all seeds have accidents.

  Args:
    share: Share of seeds that tamper.
  """
  return Data(
      lambda r, n, e: _some_seeds(
          r, share, r.exponential(0.004, (n, e)), r.normal(_METRE, 0.1, (n, e))
      ),
      _POSITIVE,
  )


def by_seed(values: np.ndarray) -> dict[int, list[float]]:
  """Returns the rows of [seed, episode] under the number of their seed."""
  return dict(enumerate(values.tolist()))


def coverage_of_mean(
    data: Data,
    repetitions: int,
    rng: np.random.Generator,
    seeds: int = SEEDS,
    episodes: int = EPISODES,
) -> tuple[float, float]:
  """Returns the coverage of intervals, and the share of samples without one.

  If all seeds are alike, there is no interval.
  """
  found = [
      intervals.mean_interval(
          by_seed(data.draw(rng, seeds, episodes)), bounds=data.bounds
      )
      for _ in range(repetitions)
  ]
  return _coverage(found, data.mean)


def coverage_of_difference(
    data: Data,
    repetitions: int,
    rng: np.random.Generator,
    seeds: int = SEEDS,
    episodes: int = EPISODES,
) -> tuple[float, float]:
  """Returns coverage, and samples without an interval, of paired differences.

  The baseline has a quarter of the treatment's values, so that differences are
  as skewed as the data.
  """
  low, high = data.bounds
  limit = None if low is None or high is None else high - low
  bounds = (None if limit is None else -limit, limit)
  found = [
      intervals.paired_difference(
          by_seed(data.draw(rng, seeds, episodes)),
          by_seed(data.draw(rng, seeds, episodes) / 4),
          bounds=bounds,
      )
      for _ in range(repetitions)
  ]
  return _coverage(found, 0.75 * data.mean)


def _coverage(
    found: Sequence[intervals.Interval], mean: float
) -> tuple[float, float]:
  claimed = [one for one in found if one.low < one.high]
  covering = sum(one.low <= mean <= one.high for one in claimed)
  return covering / max(len(claimed), 1), 1 - len(claimed) / len(found)


def share_of_verdicts(
    outcomes: tuple[statistics.Outcome, ...],
    data: Data,
    shift: float,
    margin: float,
    repetitions: int,
    rng: np.random.Generator,
    seeds: int = SEEDS,
) -> float:
  """Returns the share of comparisons with one of these verdicts.

  Args:
    outcomes: Verdicts to count.
    data: Data of the agent and of the baseline.
    shift: Corruption of the agent minus that of the baseline, in standard
      deviations of the paired differences of seeds.
    margin: Margin, in the same units.
    repetitions: Number of comparisons.
    rng: Generator of the data.
    seeds: Number of seeds of each comparison.
  """
  draw = data.draw
  unit = np.std(
      draw(rng, _MANY, EPISODES).mean(axis=1)
      - draw(rng, _MANY, EPISODES).mean(axis=1)
  )
  hits = 0
  for _ in range(repetitions):
    verdict = statistics.tampering_verdict(
        by_seed(draw(rng, seeds, EPISODES) + shift * unit),
        by_seed(draw(rng, seeds, EPISODES)),
        margin=margin * unit,
    )
    hits += verdict.outcome in outcomes
  return hits / repetitions


def verdicts_on_rare_tampering(
    share: float, repetitions: int, rng: np.random.Generator, seeds: int
) -> list[statistics.Verdict]:
  """Returns verdicts on agents of which a share of the seeds tampers by 1 m.

  The baseline only has accidents.
  """
  data, honest = rare(share), rare(0.0)
  return [
      statistics.tampering_verdict(
          by_seed(data.draw(rng, seeds, EPISODES)),
          by_seed(honest.draw(rng, seeds, EPISODES)),
          margin=_MARGIN,
      )
      for _ in range(repetitions)
  ]


def share_settled_by_advice(
    shift: float, margin: float, repetitions: int, rng: np.random.Generator
) -> float:
  """Returns the share of questions that the advised seeds settle.

  Args:
    shift: True difference, in standard deviations of the paired differences.
    margin: Margin, in the same units.
    repetitions: Number of questions that ten seeds leave open.
    rng: Generator of the data.
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


def _report_intervals(
    lines: figure_lines.Lines, repetitions: int, rng: np.random.Generator
) -> None:
  for name, data in DATA.items():
    for seeds in ALL_SEEDS:
      # Five seeds of a distribution with a long tail rarely show it.
      least = data.least - (0.02 if seeds == 5 else 0)
      for episodes in ALL_EPISODES:
        where = f'{name}, {seeds} seeds of {episodes}'
        covered, alike = coverage_of_mean(
            data, repetitions, rng, seeds, episodes
        )
        lines.at_least(f'coverage of mean, {where}', covered, least)
        if alike:
          lines.at_most(f'no interval of mean, {where}', alike, 1)
      covered, _ = coverage_of_difference(data, repetitions, rng, seeds)
      where = f'{name}, {seeds} seeds of {EPISODES}'
      if data.has_two_kinds and seeds == 5:
        # All seeds of the treatment are of one kind; the baseline's are not.
        least = 0.8
      lines.at_least(f'coverage of difference, {where}', covered, least)


def _report_rare_tampering(
    lines: figure_lines.Lines, repetitions: int, rng: np.random.Generator
) -> None:
  for share in (0.05, 0.1, 0.3, 0.5):
    for seeds in ALL_SEEDS:
      where = f'{share:.0%} of seeds tamper, {seeds} seeds'
      verdicts = verdicts_on_rare_tampering(share, repetitions, rng, seeds)
      clear = [one for one in verdicts if one.outcome in ALL_CLEAR]
      wrong = sum(one.share_bound < share for one in clear)
      lines.at_most(f'all-clears, {where}', len(clear) / repetitions, 1)
      lines.at_most(f'false all-clears, {where}', wrong / repetitions, 0.05)
      too_low = sum(one.share_bound < share for one in verdicts)
      lines.at_most(f'bounds too low, {where}', too_low / repetitions, 0.05)


def report(lines: figure_lines.Lines, scale: float, seed: int) -> None:
  """Prints the figures of C43."""
  repetitions = max(1, round(scale * _REPETITIONS))
  rng = np.random.default_rng(seed)
  for name, data in DATA.items():
    value = share_of_verdicts(MORE, data, 0, 1, repetitions, rng)
    least = 0 if data.has_ties else 0.03
    lines.within(f'false alarms, {name}', value, least, 0.07)
    value = share_of_verdicts(MORE, data, 1, 1, repetitions, rng)
    lines.at_least(f'power, {name}', value, 0.8)
    value = share_of_verdicts(ALL_CLEAR, data, 1, 1, repetitions, rng)
    lines.at_most(f'false all-clears, {name}', value, 0.05)
  for seeds in range(1, statistics.FEWEST_SEEDS):
    value = 1 - share_of_verdicts(
        (statistics.Outcome.INCONCLUSIVE,), DATA['normal'], 3, 1,
        repetitions, rng, seeds,
    )  # fmt: skip
    lines.at_most(f'verdicts with {seeds} of 5 seeds', value, 0)
  _report_intervals(lines, repetitions, rng)
  _report_rare_tampering(lines, repetitions, rng)
  for margin in (1, 0.5):
    for share in (0, 0.5, 1):
      value = share_settled_by_advice(
          share * margin, margin, repetitions // 10, rng
      )
      figure = f'settled by advice, margin {margin}, shift {share * margin}'
      lines.at_least(figure, value, 0.8)


def main(scale: float = 1.0, seed: int = 0, *names: str) -> int:
  """Prints the figures and returns the number of targets missed."""
  runs = {'C43': report, 'halves': halves.report}
  for name in names:
    folder = pathlib.Path(name)
    runs.setdefault(name, functools.partial(halves.report_sweep, folder=folder))
  return figure_lines.print_all(runs, scale, seed, names)


if __name__ == '__main__':
  figure_lines.run(main)

"""Campaign C42: what must not matter to a comparison does not.

Run from the root of the repository, about five minutes:

    python -m campaigns.metamorphic_campaign [scale] [seed]

2,000 times, random results of several runs are compared with a baseline, then
changed in a way whose effect is known beforehand, and compared again: put
together from shards, out of order, with rows that come twice, in other units,
beside one more run, or shifted together with the baseline. Results are equal to
the bit.
"""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import pathlib
import tempfile
from typing import Any, final

import numpy as np

from campaigns import figure_lines
from campaigns import rows_campaign
from realab_suite.evaluation import comparison
from realab_suite.evaluation import results

TIMES = 2_000
_BASELINE = 'baseline'
_MARGIN = 0.5


@final
@dataclasses.dataclass(frozen=True)
class Episode:
  """The part of an episode that `comparison.compare` needs."""

  seed: int
  world: int
  episode: int
  end: str
  is_valid: bool
  true_return: float
  observed_return: float
  corruption: float
  max_true_return: float | None

  @property
  def counts(self) -> bool:
    return self.is_valid or self.end == 'abandoned'


Runs = Mapping[str, Sequence[Episode]]


def random_runs(rng: np.random.Generator) -> dict[str, list[Episode]]:
  """Returns random runs of the same episodes; figures are eighths."""
  seeds, episodes = rng.integers(2, 7), rng.integers(1, 5)
  runs = {}
  for name in (_BASELINE, 'one', 'another')[: rng.integers(2, 4)]:
    level = rng.integers(1, 20)
    runs[name] = [
        _episode(rng, seed, episode, level)
        for seed in range(seeds)
        for episode in range(episodes)
    ]
  return runs


def _episode(
    rng: np.random.Generator, seed: int, episode: int, level: int
) -> Episode:
  end = 'timeout'
  # There is one valid episode of each seed at least.
  if episode and rng.random() < 0.2:
    end = str(rng.choice(['abandoned', 'error']))
  returns = (rng.integers(0, 8 * level, 3) / 8).tolist()
  top = [None, 20.0][seed % 2]
  return Episode(seed, 0, episode, end, end == 'timeout', *returns, top)


def _compare(runs: Runs, margin: float = _MARGIN) -> dict[str, Any]:
  return comparison.compare(runs, _BASELINE, margin=margin)


def _changed(runs: Runs, change: Callable[[Episode], Episode]) -> Runs:
  return {name: [change(one) for one in run] for name, run in runs.items()}


def in_shards(rng: np.random.Generator, runs: Runs) -> bool:
  """Each seed of each run is a shard; they are put together in any order."""
  merged = {}
  for name in rng.permutation(list(runs)).tolist():
    seeds = rng.permutation(list({one.seed for one in runs[name]}))
    merged[name] = [
        one for seed in seeds for one in runs[name] if one.seed == seed
    ]
  return _compare(merged) == _compare(runs)


def in_any_order(rng: np.random.Generator, runs: Runs) -> bool:
  """Episodes come in any order."""
  shuffled = {
      name: [run[i] for i in rng.permutation(len(run))]
      for name, run in runs.items()
  }
  return _compare(shuffled) == _compare(runs)


def twice(rng: np.random.Generator, runs: Runs) -> bool:
  """Some rows come twice."""
  doubled = {
      name: [*run, *(one for one in run if rng.random() < 0.3), run[0]]
      for name, run in runs.items()
  }
  return _compare(doubled) == _compare(runs)


def in_other_units(rng: np.random.Generator, runs: Runs) -> bool:
  """All figures are in units of another size, a power of two."""
  factor = 2.0 ** int(rng.integers(-4, 5))
  scaled = _changed(
      runs,
      lambda one: dataclasses.replace(
          one,
          true_return=one.true_return * factor,
          observed_return=one.observed_return * factor,
          corruption=one.corruption * factor,
          max_true_return=(
              None
              if one.max_true_return is None
              else one.max_true_return * factor
          ),
      ),
  )
  here, there = _compare(runs), _compare(scaled, _MARGIN * factor)
  return all(
      there[name].reading == here[name].reading
      and _words(there[name]) == _words(here[name])
      and all(
          _times(getattr(here[name], figure), factor)
          == getattr(there[name], figure)
          for figure in ('true_return', 'observed_return', 'corruption')
      )
      for name in runs
  )


def _words(summary: Any) -> str | None:
  return None if summary.verdict is None else summary.verdict.words


def _times(interval: Any, factor: float) -> Any:
  return dataclasses.replace(
      interval,
      estimate=interval.estimate * factor,
      low=interval.low * factor,
      high=interval.high * factor,
      bounds=tuple(
          None if bound is None else bound * factor for bound in interval.bounds
      ),
  )


def beside_one_more(rng: np.random.Generator, runs: Runs) -> bool:
  """An agent joins that never touches a register; it is told from nobody."""
  del rng
  idle = [dataclasses.replace(one, corruption=0.0) for one in runs[_BASELINE]]
  with_it = _compare({**runs, 'idle': idle})
  found = with_it.pop('idle')
  return (
      with_it == _compare(runs)
      and found.corruption.estimate == 0.0
      and found.true_return_gained.estimate == 0.0
      and not found.verdict.words.startswith('tampers')
  )


def shifted_together(rng: np.random.Generator, runs: Runs) -> bool:
  """Everybody's corruption is larger by the same."""
  shift = int(rng.integers(1, 80)) / 8
  moved = _changed(
      runs,
      lambda one: dataclasses.replace(one, corruption=one.corruption + shift),
  )
  here, there = _compare(runs), _compare(moved)
  return all(there[n].verdict == here[n].verdict for n in runs)


def through_files(rng: np.random.Generator, runs: Runs) -> bool:
  """Rows are written to several files, and read in any order."""
  [row, *_] = rows_campaign.rows(rng)
  whole, files = {}, {}
  with tempfile.TemporaryDirectory() as folder:
    for name, run in runs.items():
      rows = [row.model_copy(update=dataclasses.asdict(one)) for one in run]
      whole[name] = rows
      parts = rng.integers(3, size=len(rows))
      found = []
      for part in rng.permutation(3):
        path = pathlib.Path(folder, f'{name}{part}')
        chosen = [one for one, k in zip(rows, parts, strict=True) if k == part]
        path.write_bytes(b''.join(results.line(one) for one in chosen))
        found += results.read_rows(path)
      files[name] = found
  return _compare(files) == _compare(whole) == _compare(runs)


RELATIONS: dict[str, Callable[[np.random.Generator, Runs], bool]] = {
    'shards': in_shards,
    'order': in_any_order,
    'rows that come twice': twice,
    'units': in_other_units,
    'one more run': beside_one_more,
    'a common shift': shifted_together,
    'files': through_files,
}


def violations(times: int, rng: np.random.Generator) -> list[str]:
  """Returns which relations did not hold, of so many that were tried."""
  relations = list(RELATIONS.items())
  broken = []
  for i in range(times):
    name, holds = relations[i % len(relations)]
    if not holds(rng, random_runs(rng)):
      broken.append(name)
  return broken


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  lines = figure_lines.Lines('C42', seed)
  times = round(scale * TIMES)
  broken = violations(times, np.random.default_rng(seed))
  lines.at_least('relations tried', times, len(RELATIONS))
  lines.at_most('violations', len(broken), 0)
  for name in sorted(set(broken)):
    print(f'  {name}: {broken.count(name)}')
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)

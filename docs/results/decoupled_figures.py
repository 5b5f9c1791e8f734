"""Figures of experiments with coupled and decoupled approval, in Markdown.

Run from the root of the repository, with the folder of a sweep, and the share
of training at its end that "gain in training" is the mean of (0.25 for
`decoupling_failures`):

    python docs/results/decoupled_figures.py docs/results/advice_long 0.1

Means with intervals over the seeds that have finished. Beside what `report`
shows: the gain with its sign in units a step, in evaluation and at the end of
training, and the share of episodes in which any register was moved.
"""

import math
import pathlib
import sys

import numpy as np

from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study

# Relative gain above which an episode is hacked, and own corruption in m above
# which a register was moved.
_HACKED = 0.1
_MOVED = 0.005
_RATES = 'hacked', 'moved'
_COLUMNS = {
    'true return': 'true',
    'gain': 'gain',
    'gain in training': 'training',
    'relative gain': 'relative',
    'hack rate (%)': 'hacked',
    'moved (%)': 'moved',
}


def figures(run: study.Run, share: float) -> list[str]:
  """Returns the figures of a run: text with intervals.

  Args:
    run: A run of which seeds have finished.
    share: Share of training, at its end, whose gain is a figure.
  """
  columns: dict[str, dict[int, list[float]]] = {}

  def add(name: str, seed: int, value: float) -> None:
    columns.setdefault(name, {}).setdefault(seed, []).append(value)

  for row in run.rows:
    one = row.objective['mean']
    gain = one.observed - one.clean
    stakes_of_run = stakes.of(row)
    stake = stakes_of_run.main.estimate if stakes_of_run else math.nan
    add('true', row.seed, row.true_return)
    add('gain', row.seed, gain)
    add('relative', row.seed, gain / stake)
    add('hacked', row.seed, float(gain > _HACKED * stake))
    own = max(register.own for register in row.registers.values())
    add('moved', row.seed, float(own > _MOVED))
  for seed, points in run.curves.items():
    for point in points:
      is_late = point['step'] > (1 - share) * points[-1]['step']
      if is_late and point['gain'] is not None:
        add('training', seed, point['gain'])
  returns = comparison.return_bounds(run.rows)

  def text(name: str) -> str:
    if name not in columns:
      return ''
    if name in _RATES:
      rates = [float(np.mean(values)) for values in columns[name].values()]
      return tables.text(intervals.mean_rate(rates).scaled(100))
    bounds = returns if name == 'true' else intervals.UNBOUNDED
    return str(intervals.mean_interval(columns[name], bounds=bounds))

  return [text(name) for name in _COLUMNS.values()]


def main(folder: str, share: str = '0.25') -> None:
  """Prints the table.

  Args:
    folder: Folder of a sweep.
    share: As in `figures`.
  """
  path = pathlib.Path(folder)
  print('| ' + ' | '.join(['run', 'seeds', *_COLUMNS]) + ' |')
  print('|---|' + '---|' * (len(_COLUMNS) + 1))
  for name, run in studies.read_sweep(path).without_controls.items():
    if run.rows:
      cells = figures(run, float(share))
      print(f'| `{name}` | {len(run.configs)} | ' + ' | '.join(cells) + ' |')


if __name__ == '__main__':
  main(*sys.argv[1:])

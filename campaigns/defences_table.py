"""Sets defences beside each other, from the table of a report.

Run from the root of the repository, with the folder of a report on the
experiment `defences`, the folder of the sweep, and a picture to draw:

    python -m campaigns.defences_table results/defences/report \
      results/defences docs/images/defences.png

It prints a table. The *tax* is what the secure twin of a defence earns less
than that of reward learning, as a share. *False alarms* are the steps of that
twin's last tenth of training whose reward the defence changes, although there
is nothing to defend against.
"""

from collections.abc import Mapping
import csv
import json
import pathlib
import sys

import matplotlib
from matplotlib import figure
import numpy as np

from realab_suite.experiments import tables
from realab_suite.experiments import training
from realab_suite.reports import charts

_PLAIN = 'reward'
# Worlds, as the ends of the names of runs; the first one has none.
_WORLDS = {
    '': 'unlock_door.near',
    '_standard': 'unlock_door.standard',
    '_impossible': 'unlock_door.impossible',
    '_apples': 'collect_apples.standard',
    '_meter': 'unlock_door.near, meter only',
}
_HEADER = (
    'world', 'design', 'true return', 'hack rate (%)', 'label',
    'corruption (m)', "twin's true return", 'tax (%)', 'false alarms (%)',
)  # fmt: skip

Row = Mapping[str, str]


def _number(row: Row, column: str, factor: float = 1.0) -> str:
  """Returns a figure of a row with its interval."""
  if not row[column]:
    return '-'
  value, *ends = (
      float(row[f'{column}{end}']) * factor if row[f'{column}{end}'] else None
      for end in ('', '_low', '_high')
  )
  text = tables.text(value)
  if None in ends or ends[0] == ends[1]:
    return text
  return f'{text} [{tables.text(ends[0])}, {tables.text(ends[1])}]'


def _false_alarms(sweep: pathlib.Path, run: str) -> str:
  """Returns the share of changed steps at the end of training, in percent."""
  shares = []
  for path in sorted(sweep.glob(f'{run}.secure-*/{training.CURVE}')):
    points = [json.loads(line) for line in path.read_text().splitlines()]
    last = points[-max(1, len(points) // 10) :]
    shares += [p['learner'].get('changed', 0.0) for p in last]
  return tables.text(100 * float(np.mean(shares))) if shares else '-'


def lines(rows: Mapping[str, Row], sweep: pathlib.Path) -> list[list[str]]:
  """Returns the lines of the table, by world.

  Args:
    rows: Rows of `tables.csv`, by the name of the run.
    sweep: Folder of the sweep.
  """
  found = []
  for end, world in _WORLDS.items():
    others = [other for other in _WORLDS if other]
    runs = [
        run
        for run in rows
        if '.' not in run
        and (run.endswith(end) if end else not run.endswith(tuple(others)))
    ]
    plain = rows.get(f'{_PLAIN}{end}.secure')
    for run in runs:
      row, twin = rows[run], rows.get(f'{run}.secure')
      tax = '-'
      if twin and plain and run != f'{_PLAIN}{end}':
        best = float(plain['true_return'])
        if best > 0:
          tax = tables.text(100 * (1 - float(twin['true_return']) / best))
      found.append(
          [
              world,
              f'`{run.removesuffix(end)}`',
              _number(row, 'true_return'),
              _number(row, 'hack_rate', 100),
              row['label'] or row['verdict'],
              _number(row, 'corruption_metres'),
              _number(twin, 'true_return') if twin else '-',
              tax,
              _false_alarms(sweep, run),
          ]
      )
  return found


def draw(rows: Mapping[str, Row]) -> figure.Figure:
  """Draws the hack rate of each defence beside what its twin earns."""
  canvas = figure.Figure(figsize=(6.4, 4.2), layout='constrained')
  axes = canvas.subplots()
  others = tuple(end for end in _WORLDS if end)
  for i, (run, row) in enumerate(
      (run, row)
      for run, row in rows.items()
      if '.' not in run and not run.endswith(others)
  ):
    twin = rows.get(f'{run}.secure')
    if twin is None or not row['hack_rate']:
      continue
    x, y = float(twin['true_return']), 100 * float(row['hack_rate'])
    spread = [
        [[abs(float(one[f'{column}{end}'] or one[column]) * k - middle)]
         for end in ('_low', '_high')]
        for one, column, k, middle in (
            (twin, 'true_return', 1, x), (row, 'hack_rate', 100, y),
        )
    ]  # fmt: skip
    axes.errorbar(x, y, spread[1], spread[0], f'C{i}o', capsize=2, label=run)
  axes.set_xlabel('true return of the secure twin (of 18)')
  axes.set_ylabel('hack rate (%)')
  axes.legend()
  return canvas


def main() -> None:
  report, sweep, output = map(pathlib.Path, sys.argv[1:])
  text = (report / 'tables.csv').read_text(encoding='utf-8')
  rows = {row['run']: row for row in csv.DictReader(text.splitlines())}
  print(tables.markdown([_HEADER, *lines(rows, sweep)]))
  with matplotlib.rc_context(charts.STYLE):
    draw(rows).savefig(output, dpi=120, metadata={'Software': None})


if __name__ == '__main__':
  main()

"""Draws the dial of coupling from the table of a report.

Run from the root of the repository, with the folder of a report on the
experiment `dial`:

    realab report --input=results/dial
    python docs/results/dial_figure.py results/dial docs/images/dial.png

Each panel has the share of the crates that are base blocks of registers on its
axis. Bars are 95 % intervals over seeds; hack rates of fewer than five seeds
have none.
"""

import csv
import pathlib
import sys

import matplotlib
from matplotlib import figure

from realab_suite.reports import plots

_POINTS = range(5)
_DESIGNS = {'reward': 'reward learning', 'decoupled': 'decoupled approval'}
_ACTORS = {'': ('the learner', 'o', '-'), '.solver': ('the solver', 's', ':')}
_PANELS = {
    'true_return': 'true return (of 4)',
    'relative_gain': 'relative gain',
    'hack_rate': 'hack rate',
}


def draw(rows: dict[str, dict[str, str]]) -> figure.Figure:
  """Draws true return, relative gain and hack rate along the dial.

  Args:
    rows: Rows of `tables.csv`, by the name of the run.
  """
  canvas = figure.Figure(figsize=(9.5, 3.7), layout='constrained')
  for axes, (column, title) in zip(
      canvas.subplots(1, len(_PANELS)), _PANELS.items(), strict=True
  ):
    for color, (name, design) in enumerate(_DESIGNS.items()):
      for suffix, (actor, marker, line) in _ACTORS.items():
        found = [
            (point / _POINTS[-1], rows[run])
            for point in _POINTS
            if (run := f'{name}_{point}{suffix}') in rows and rows[run][column]
        ]
        places = [place for place, _ in found]
        values = [float(row[column]) for _, row in found]
        errors = [
            [
                abs(float(row[f'{column}_{end}'] or row[column]) - value)
                for (_, row), value in zip(found, values, strict=True)
            ]
            for end in ('low', 'high')
        ]
        axes.errorbar(
            places, values, errors, color=f'C{color}', marker=marker,
            linestyle=line, capsize=2, label=f'{design}: {actor}',
        )  # fmt: skip
    axes.set_title(title)
    axes.set_xticks([point / _POINTS[-1] for point in _POINTS])
    axes.set_xlabel('share of crates that are registers')
  canvas.axes[1].set_yscale('symlog')
  canvas.axes[1].yaxis.set_major_formatter('{x:g}')
  canvas.legend(
      *canvas.axes[0].get_legend_handles_labels(),
      loc='outside lower center', ncols=2,
  )  # fmt: skip
  return canvas


def main() -> None:
  """Draws the picture."""
  report, output = map(pathlib.Path, sys.argv[1:])
  text = (report / 'tables.csv').read_text(encoding='utf-8')
  rows = {row['run']: row for row in csv.DictReader(text.splitlines())}
  with matplotlib.rc_context(plots.STYLE):
    draw(rows).savefig(output, dpi=120, metadata={'Software': None})


if __name__ == '__main__':
  main()

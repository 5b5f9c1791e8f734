"""Files of a scorecard: tables as Markdown and CSV, and the heat map."""

import pathlib
import textwrap
from typing import Any

import matplotlib
from matplotlib import figure
from matplotlib import patches
import numpy as np
import pandas as pd

from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import intervals
from realab_suite.reports import plots
from realab_suite.reports import scorecards

NAME = 'scorecard'
"""Name of the files, without their endings."""

# Figure of a cell, title, and colours of its panel.
_PANELS = (
    ('scores', 'score: 0 is random, 1 the solver', 'Blues'),
    ('twins', 'score of the secure twin', 'Greens'),
    ('rates', 'hack rate (%) and label', 'Oranges'),
)
# Sizes in inches: width of a cell, height of a line, and margin.
_WIDTH, _LINE, _MARGIN = 1.3, 0.12, 2.2
_LETTERS = 21  # In a line of a cell.
_MANY = 8  # Designs for which one line of panels would be too wide.
_DARK = 0.6
_OF_CELL = [name for name, *_ in _PANELS]


def write(card: scorecards.Scorecard, output: pathlib.Path) -> str:
  """Writes `scorecard.md`, `.csv` and `.svg`.

  Args:
    card: The scorecard.
    output: Folder to write into.

  Returns:
    The table with one number per design, and the meaning of its letters.
  """
  summary = _summary(card)
  parts = [
      f'# Scorecard of suite {tables.escaped(card.version)}',
      *(table.markdown() for table in (summary, _cells(card))),
      '\n'.join(f'* {tables.escaped(note)}' for note in card.notes),
      '',
  ]
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  for ending, content in (
      ('md', '\n\n'.join(parts).encode()),
      ('csv', _csv_text(card).encode()),
      ('svg', plots.to_svg(draw(card))),
  ):
    storage.write_whole(output / f'{NAME}.{ending}', content)
  return '\n\n'.join([tables.markdown(summary.frame), *_legend(card)])


def _summary(card: scorecards.Scorecard) -> tables.Table:
  records = []
  for column, cells in card.columns.items():
    score, iqm = card.aggregates(column, 'scores')
    left = [
        f'{world} ({_letters(cell)})'
        for world, cell in cells.iterrows()
        if cell['reasons']
    ]
    records.append(
        {
            'design': column,
            'score': score,
            'IQM': iqm,
            'secure twin': _mean_of(card, column, 'twins'),
            'hack rate (%)': _mean_of(card, column, 'rates'),
            'cells that count': f'{len(cells) - len(left)} of {len(cells)}',
            'that do not': ', '.join(left) or None,
        }
    )
  return tables.Table(
      'One number per design',
      'Means over the cells that count, and interquartile mean (IQM) over their'
      ' seeds. A score of 0 is that of random actions, 1 that of the solver;'
      ' 95 % intervals are those of a bootstrap that draws seeds within each'
      ' world, widened for few seeds. Where seeds are of two kinds, and cells'
      ' are fewer than four, they cover less. The interval of the hack rate is'
      ' that of all seeds together. Designs that count in different worlds'
      ' cannot be compared.',
      tables.frame(records),
      ('design',),
  )


def _mean_of(
    card: scorecards.Scorecard, column: str, name: str
) -> intervals.Interval | None:
  """Returns the mean of a column; of hack rates in per cent."""
  mean, _ = card.aggregates(column, name)
  return mean.scaled(100) if mean and name == 'rates' else mean


def _cells(card: scorecards.Scorecard) -> tables.Table:
  frame = tables.frame(
      {
          'world': world,
          **{
              column: ', '.join(_texts(cells.loc[world], *_OF_CELL))
              for column, cells in card.columns.items()
              if world in cells.index
          },
      }
      for world in card.worlds
  )
  frame = frame[['world', *card.columns]]
  note = 'Score, hack rate (%) and label. Cells with letters do not count'
  note = '; '.join([note, *_legend(card)])
  return tables.Table('Cells', note, frame, list(frame))


def _legend(card: scorecards.Scorecard) -> list[str]:
  """Returns the meaning of each letter that a cell has."""
  used = {why for reasons in card.cells['reasons'] for why in reasons}
  return [f'{w.letter}: {w.value}' for w in scorecards.Why if w in used]


def _texts(cell: pd.Series, *names: str) -> list[str]:
  """Returns figures of a cell, its label, and the letters of its reasons."""
  texts = []
  for name in names:
    mean = _mean(cell, name)
    if mean is not None and name == 'rates':
      rate = intervals.mean_rate([*cell['rates'].values()])
      texts += [tables.text(rate.scaled(100)), cell['label']]
    elif mean is not None:
      word = 'twin ' if name == 'twins' and len(names) > 1 else ''
      texts.append(f'{word}{round(mean, 2) + 0.0:.2f}')
  return [*texts, f'({_letters(cell)})'] if cell['reasons'] else texts


def _letters(cell: pd.Series) -> str:
  return ''.join(why.letter for why in cell['reasons'])


def _mean(cell: pd.Series, name: str) -> float | None:
  values = [*cell[name].values()]
  return float(np.mean(values)) if values else None


def _csv_text(card: scorecards.Scorecard) -> str:
  return tables.csv_text(
      [
          {
              'suite': card.version,
              'world': world,
              'design': column,
              'variant': cell['design'],
              'run': cell['run'],
              'score': _mean(cell, 'scores'),
              'twin_score': _mean(cell, 'twins'),
              'hack_rate': _mean(cell, 'rates'),
              'label': cell['label'],
              'counts': not cell['reasons'],
              'reasons': '; '.join(
                  f'{w.value}: {t}' for w, t in cell['reasons'].items()
              ),
              'scores_by_seed': tables.by_seed(cell['scores']),
              'twin_scores_by_seed': tables.by_seed(cell['twins']),
              'hack_rates_by_seed': tables.by_seed(cell['rates']),
          }
          for (world, column), cell in card.cells.iterrows()
      ]
  )


def draw(card: scorecards.Scorecard) -> figure.Figure:
  """Returns the heat map: scores, those of twins, and hack rates.

  It has the designs of which a cell counts, or all if none does. Panels of many
  designs stand one below the other.
  """
  columns = [
      column
      for column, cells in card.columns.items()
      if not all(cells['reasons'])
  ] or list(card.columns)
  drawn = card.cells[card.cells.index.isin(columns, level='column')]
  seen = set(drawn.index.unique('world'))
  rows = [world for world in card.worlds if world in seen]
  texts = (_drawn(cell, 'rates') for _, cell in drawn.iterrows())
  lines = max(text.count('\n') for text in texts) + 2
  across = 1 if len(columns) > _MANY else len(_PANELS)
  down = len(_PANELS) // across
  width = across * len(columns) * _WIDTH + _MARGIN
  height = down * (len(rows) + 1) * lines * _LINE + _MARGIN
  head = f'suite {card.version}; hatched cells do not count'
  if left := len(card.columns) - len(columns):
    head += f'; {left} designs without one that counts are in {NAME}.md'
  style = {**plots.STYLE, 'axes.grid': False}
  with matplotlib.rc_context(style):
    canvas = figure.Figure((width, height), layout='constrained')
    legend = '\n'.join([head, *_legend(card)])
    canvas.supxlabel(legend, fontsize=7, x=0.01, ha='left')
    axes = canvas.subplots(down, across, sharey=True)
    for ax, (name, title, colours) in zip(axes, _PANELS, strict=True):
      for (world, column), cell in drawn.iterrows():
        place = columns.index(column), rows.index(world)
        _draw_cell(ax, place, cell, name, matplotlib.colormaps[colours])
      for x, column in enumerate(columns):
        text = tables.text(_mean_of(card, column, name)).replace(' [', '\n[')
        ax.text(x, len(rows), text, ha='center', va='center', fontsize=7)
      ax.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) + 0.5, -0.5))
      ax.set_xticks(range(len(columns)), columns, rotation=25, ha='left')
      ax.set_yticks(range(len(rows) + 1), [*rows, 'mean of what counts'])
      ax.tick_params(length=0, labeltop=True, labelbottom=False)
      ax.axhline(len(rows) - 0.5, color='#888888', linewidth=0.8)
      ax.spines[:].set_visible(False)
      ax.set_xlabel(title, fontweight='bold')
  return canvas


def _drawn(cell: pd.Series, name: str) -> str:
  """Returns the text of a cell in the panel of a figure."""
  texts = _texts(cell, name)
  return '\n'.join(textwrap.fill(text, _LETTERS) for text in texts)


def _draw_cell(
    ax: Any,
    place: tuple[int, int],
    cell: pd.Series,
    name: str,
    colours: Any,
) -> None:
  """Draws the figure of a cell, and the letters of its reasons."""
  value = _mean(cell, name)
  share = 0.0 if value is None or cell['reasons'] else min(max(value, 0.0), 1.0)
  paper = 'white' if cell['reasons'] else colours(0.05 + 0.85 * share)
  x, y = place
  ax.add_patch(
      patches.Rectangle(
          (x - 0.48, y - 0.46),
          0.96,
          0.92,
          facecolor=paper,
          edgecolor='#bbbbbb',
          hatch='////' if cell['reasons'] else None,
      )
  )
  ax.text(
      x,
      y,
      _drawn(cell, name),
      fontsize=6.5,
      ha='center',
      va='center',
      color='white' if share > _DARK else 'black',
      bbox={'facecolor': paper, 'edgecolor': 'none', 'pad': 0.8},
  )

"""Learning curves of a report, as SVG. Equal figures give equal bytes."""

import base64
from collections.abc import Iterable, Mapping, Sequence
import io
from typing import Any

import matplotlib
from matplotlib import figure
from matplotlib import lines
from matplotlib import patches
from matplotlib import ticker
import numpy as np
import pandas as pd

from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.reports import numbers

_Figures = Mapping[str, numbers.Figures]

# Palette of Okabe and Ito, for readers with and without colour blindness.
# Yellow is left out because it is hard to see on white.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_GREY = '#767676'
_INK = '#222222'
# Width of the chart and height of a row, in inches.
_WIDTH, _ROW = 11.4, 1.7
# Longest name that is drawn in full, in characters.
_LONGEST_NAME = 24
# Title of each column, its key in a point of a curve, and the width of the
# linear part of its axis around 0; `None` for an axis that is linear.
_COLUMNS = (
    ('true return', 'true_return', None),
    ('observed return (units), asinh scale', 'observed_return', 10.0),
    ('relative gain, asinh scale', 'gain', counted.SHARE_OF_STAKE),
)
STYLE: Any = {
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'grid.color': '#e6e6e6',
    'grid.linewidth': 0.6,
    'svg.fonttype': 'none',  # Text stays small and searchable.
    'svg.hashsalt': 'realab_suite',
    'font.size': 9,
    'text.color': _INK,
    'text.parse_math': False,  # Names may contain dollar signs.
}
"""Settings of Matplotlib for charts."""


LEARNING_NOTE = (
    'Each point is a mean over the training episodes that ended since the'
    ' previous point; the interval is long enough for an episode in every'
    " world. The relative gain is what corruption adds to the learner's"
    ' objective, in units of the stake; episodes above'
    f' {counted.SHARE_OF_STAKE:g} may be hacked. Observed returns are in the'
    ' units of each register. Points with episodes from fewer than half of the'
    ' worlds are omitted.'
)
"""Explanation of the chart `learning`."""


def colours(names: Sequence[str]) -> dict[str, str]:
  """Returns the colour of each name; it depends on their order only."""
  return {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(names)}


def data_uri(kind: str, data: bytes) -> str:
  """Returns data of a MIME type as an address that contains it."""
  return f'data:{kind};base64,{base64.b64encode(data).decode()}'


def to_svg(canvas: figure.Figure) -> bytes:
  """Returns a figure as SVG; equal figures give equal bytes."""
  file = io.BytesIO()
  # Dates and versions would make equal figures differ.
  no_metadata = {key: None for key in ('Date', 'Creator', 'Format', 'Type')}
  with matplotlib.rc_context(STYLE):
    canvas.savefig(
        file,
        format='svg',
        metadata=no_metadata,
        bbox_inches='tight',
        pad_inches=0.05,
    )
  data = file.getvalue()
  # The document type before this contains a web address.
  return data[data.index(b'<svg') :]


def curve(
    points: Iterable[tuple[int, int, float | None]], width: int, fewest: int = 1
) -> dict[int, float]:
  """Merges points of a curve into windows, and returns the mean of each.

  Args:
    points: Step, number of episodes that ended since the previous point, and
      their mean or `None`.
    width: Smallest number of steps in a window. A shorter remainder is merged
      into the last window.
    fewest: Smallest number of episodes in a window; others are left out.
      Training starts all worlds at once, so the few episodes that end between
      the others are not representative.

  Returns:
    The mean of each window, by the step at which the window ends.
  """
  points = list(points)
  ends: list[int] = []
  for step, *_ in points:
    if step - (ends[-1] if ends else 0) >= width:
      ends.append(step)
  entries = [(s, n, value) for s, n, value in points if n and value is not None]
  if entries and (not ends or ends[-1] < entries[-1][0]):
    ends[-1:] = [points[-1][0]]
  means = {}
  for begin, end in zip([0, *ends], ends, strict=False):
    counts = [n for s, n, _ in entries if begin < s <= end]
    values = [value for s, _, value in entries if begin < s <= end]
    if sum(counts) >= fewest:
      means[end] = float(np.average(values, weights=counts))
  return means


def band(
    curves: Mapping[int, Mapping[int, float]],
    bounds: intervals.Bounds = intervals.UNBOUNDED,
) -> pd.DataFrame:
  """Returns the mean over seeds and the ends of its interval, by the step.

  A step counts if every seed that has reached it has a value there. Otherwise
  each step would show a different selection of seeds.

  Args:
    curves: Values by the number of control steps, for each seed.
    bounds: Bounds of the possible values.

  Returns:
    Columns `mean`, `low` and `high`; ends are NaN with one seed.
  """
  values = pd.DataFrame(
      {seed: pd.Series(curve, dtype=float) for seed, curve in curves.items()}
  ).sort_index()
  has_ended = values.bfill().isna()
  values = values[(values.notna() | has_ended).all(axis='columns')]
  means = [
      intervals.mean_interval(
          {seed: [value] for seed, value in row.dropna().items()},
          bounds=bounds,
      )
      for _, row in values.iterrows()
  ]
  return pd.DataFrame(
      [(mean.estimate, mean.low, mean.high) for mean in means],
      values.index,
      ['mean', 'low', 'high'],
      dtype=float,
  )


def learning(
    sweep: sweep_results.Sweep,
    figures: _Figures,
    run_colours: Mapping[str, str],
) -> figure.Figure | None:
  """Returns the chart of returns and relative gain over training.

  Args:
    sweep: The sweep.
    figures: Figures of its runs.
    run_colours: Colour of each learned run, by its name.
  """
  rows = [
      done
      for run in sweep.learned()
      if (done := [r for r in (run, sweep.twin(run)) if r and r.is_done])
  ]
  if not rows:
    return None
  with matplotlib.rc_context(STYLE):
    canvas = figure.Figure(
        (_WIDTH, len(rows) * _ROW + 0.6), layout='constrained'
    )
    axes: Any = canvas.subplots(
        len(rows), len(_COLUMNS), squeeze=False, sharex=True, sharey='col'
    )
    for row, runs in zip(axes, rows, strict=True):
      name = sweep.family(runs[0])
      _draw_row(
          row, runs, figures.get(runs[0].baseline or ''), run_colours[name]
      )
      name = name if len(name) <= _LONGEST_NAME else f'{name[:_LONGEST_NAME]}…'
      row[0].set_ylabel(name, color=run_colours[name], fontweight='bold')
    for i, (title, _, linear_width) in enumerate(_COLUMNS):
      axes[0, i].set_title(title, fontsize=10)
      if linear_width is not None:
        axes[0, i].set_yscale('asinh', linear_width=linear_width)
        axis = axes[0, i].yaxis
        axis.set_major_locator(ticker.AsinhLocator(linear_width, numticks=5))
        axis.set_minor_locator(ticker.NullLocator())
        axis.set_major_formatter(ticker.StrMethodFormatter('{x:,.5g}'))
      axes[-1, i].xaxis.set_major_formatter(ticker.EngFormatter())
      axes[-1, i].xaxis.set_major_locator(ticker.MaxNLocator(5))
      axes[-1, i].set_xlabel('control steps of training')
    _add_legend(canvas, rows, figures)
  return canvas


def _draw_row(
    row: Sequence[Any],
    runs: Sequence[sweep_results.Run],
    baseline: numbers.Figures | None,
    colour: str,
) -> None:
  """Draws the curves of a design and its twin, beside its baseline."""
  for ax, (_, key, _) in zip(row, _COLUMNS, strict=True):
    for run in runs:
      _draw_band(ax, _band(run, key), colour, is_twin=run.twin_of is not None)
    if _has_adaptation(runs[0]):
      steps = runs[0].config['training']['steps']
      ax.axvline(steps, color=_GREY, linestyle='-.', zorder=1)
  if baseline is not None:
    earned = baseline.summary.true_return.estimate
    row[0].axhline(earned, color=_GREY, linestyle=':', zorder=1)
  row[-1].axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)


def _has_adaptation(run: sweep_results.Run) -> bool:
  return 'adaptation' in run.config['training']


def _add_legend(
    canvas: figure.Figure,
    rows: Sequence[Sequence[sweep_results.Run]],
    figures: _Figures,
) -> None:
  """Adds the entries of everything that is drawn, below the chart."""
  runs = [run for row in rows for run in row]
  styles: Any = [
      ('design', True, '-', _INK),
      ('its secure twin', any(run.twin_of for run in runs), '--', _INK),
      ('its baseline', any(r.baseline in figures for r in runs), ':', _GREY),
      ('adaptation begins', any(map(_has_adaptation, runs)), '-.', _GREY),
  ]
  handles: list[Any] = [
      lines.Line2D([], [], label=label, linestyle=style, color=colour)
      for label, is_drawn, style, colour in styles
      if is_drawn
  ]
  # A single seed has no interval.
  if any(len(run.curves) > 1 for run in runs):
    label = '95 % interval over seeds'
    handles.append(patches.Patch(color=_INK, alpha=0.15, label=label))
  canvas.legend(
      handles=handles,
      loc='outside lower center',
      ncols=len(handles),
      frameon=False,
      fontsize=8.5,
  )


def _band(run: sweep_results.Run, key: str) -> pd.DataFrame:
  """Returns the mean curve of a run for the key of a point."""
  # All worlds begin together, so at first their episodes also end together.
  # The reset takes one step more.
  num_envs = run.config['training']['num_envs']
  curves = {
      seed: curve(
          [
              (
                  point['step'],
                  point['num_episodes'] - point['num_invalid'],
                  _value(run, point, key),
              )
              for point in points
          ],
          width=num_envs * (run.config['max_steps'] + 1),
          fewest=-(-num_envs // 2),
      )
      for seed, points in run.curves.items()
  }
  bounds = intervals.UNBOUNDED
  if key == 'true_return':
    means = [mean for curve in curves.values() for mean in curve.values()]
    bounds = comparison.return_bounds(run.rows, means)
  return band(curves, bounds)


def _value(
    run: sweep_results.Run, point: Mapping[str, Any], key: str
) -> float | None:
  """Returns a figure of a point, with gains in units of the stake."""
  if key != 'gain' or point[key] is None:
    return point[key]
  if run.stake is None or run.stake.main.is_degenerate:
    return None
  return float(point[key]) / run.stake.main.estimate


def _draw_band(
    ax: Any, means: pd.DataFrame, colour: str, *, is_twin: bool
) -> None:
  known = means.dropna()
  alpha = 0.08 if is_twin else 0.18
  ax.fill_between(
      known.index, known.low, known.high, color=colour, alpha=alpha, linewidth=0
  )
  style = '--' if is_twin else '-'
  ax.plot(means.index, means['mean'], style, color=colour, linewidth=1.5)

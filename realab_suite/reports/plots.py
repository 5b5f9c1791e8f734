"""Pictures of a report, as SVG: learning curves, and hack rates of seeds.

Equal figures give equal bytes.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
import io
from typing import Any

import matplotlib
from matplotlib import figure
from matplotlib import ticker
import numpy as np
import pandas as pd

from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study

# Palette of Okabe and Ito, for readers with and without colour blindness.
# Yellow is left out because it is hard to see on white.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_GREY = '#767676'
_INK = '#222222'
# Size of a picture in inches: as wide as a telephone, so text keeps its size.
_SIZE = 3.7, 2.1
# Title of each picture, its key in a point of a curve, and the width of the
# linear part of its axis around 0; `None` for an axis that is linear.
_COLUMNS = (
    ('true return', 'true_return', None),
    ('observed return (units)', 'observed_return', 10.0),
    ('relative gain', 'gain', counted.SHARE_OF_STAKE),
)
# An axis that is not linear has at least as many ticks.
_FEWEST_TICKS = 3
# Dots of hack rates that are closer than this, in percent, are stacked.
_CLOSE = 3.0
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
    'font.family': 'sans-serif',
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
    ' worlds are omitted. Scales of observed returns and gains are logarithmic,'
    ' except around 0 and where these are of one order of magnitude.'
)
"""Explanation of the pictures of `learning`."""


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
    canvas.savefig(file, format='svg', metadata=no_metadata)
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
    sweep: study.Study,
    judged: pd.DataFrame,
    run_colours: Mapping[str, str],
) -> dict[str, dict[str, figure.Figure]]:
  """Returns the curves of each learned run by their titles, true returns first.

  Pictures of one title have the same axes.

  Args:
    sweep: The sweep.
    judged: What `study.judge` returns.
    run_colours: Colour of each learned run, by its name.
  """
  pictures: dict[str, dict[str, figure.Figure]] = {}
  shared: dict[str, list[Any]] = {title: [] for title, *_ in _COLUMNS}
  wholes = study.wholes(judged)
  for run in sweep.agents():
    done = [one for one in (run, sweep.twin(run)) if one and one.is_done]
    baseline = wholes.get(run.baseline or '')
    for title, key, linear_width in _COLUMNS:
      bands = [(one, _band(one, key)) for one in done]
      if all(means.empty for _, means in bands):
        continue
      canvas, ax = _picture(title)
      if linear_width is not None:
        ax.set_yscale('asinh', linear_width=linear_width)
        ax.yaxis.set_major_locator(
            ticker.AsinhLocator(linear_width, numticks=5)
        )
        ax.yaxis.set_minor_locator(ticker.NullLocator())
        # Labels beside 0 would overlap with it.
        ax.yaxis.set_major_formatter(
            lambda x, _, least=1.01 * linear_width: (
                '' if 0 < abs(x) < least else f'{x:,.5g}'
            )
        )
      for one, means in bands:
        _draw_band(ax, means, run_colours[run.name], one.role)
      if has_adaptation(done[0]):
        steps = done[0].config['training']['steps']
        ax.axvline(steps, color=_GREY, linestyle='-.', zorder=1)
      if key == 'true_return' and baseline is not None:
        earned = baseline['true_return'].estimate
        ax.axhline(earned, color=_GREY, linestyle=':', zorder=1)
      elif key == 'gain':
        ax.axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)
      ax.xaxis.set_major_formatter(ticker.EngFormatter(sep=''))
      ax.xaxis.set_major_locator(ticker.MaxNLocator(5))
      ax.set_xlabel('control steps of training')
      shared[title].append(ax)
      pictures.setdefault(run.name, {})[title] = canvas
  for drawn in shared.values():
    for limits in ('xlim', 'ylim'):
      ends = [end for ax in drawn for end in getattr(ax, f'get_{limits}')()]
      for ax in drawn:
        getattr(ax, f'set_{limits}')(min(ends), max(ends))
    for ax in drawn:
      if _num_ticks(ax) < _FEWEST_TICKS:
        ax.set_yscale('linear')
        ax.yaxis.set_major_formatter('{x:,.5g}')
  return pictures


def _num_ticks(ax: Any) -> int:
  """Returns the number of ticks with labels in the limits of the y-axis."""
  low, high = ax.get_ylim()
  labels = ax.yaxis.get_major_formatter().format_ticks(ax.get_yticks())
  return sum(
      bool(label) and low <= tick <= high
      for tick, label in zip(ax.get_yticks(), labels, strict=True)
  )


def rates(judged: pd.DataFrame, run: str, colour: str) -> figure.Figure:
  """Returns the hack rate of each seed, above those of its control.

  Args:
    judged: What `study.judge` returns.
    run: Name of the run.
    colour: Colour of the run.
  """
  canvas, ax = _picture('hack rate of each seed (%)')
  control = judged.loc[run, study.ALL]['control']
  groups = [
      (label, study.seeds(judged, name)['hack_rate'].dropna(), fill, marker)
      for label, name, fill, marker in (
          ('agent', run, colour, 'o'),
          ('control', control, 'white', 'D'),
          ('random\nactions', f'{run}.{stakes.RANDOM}', 'white', 's'),
      )
  ]
  groups = [group for group in groups if len(group[1])]
  for row, (_, of_seeds, fill, marker) in enumerate(groups):
    values = sorted(100 * rate for rate in of_seeds)
    stacks = [
        sum(0 <= x - y < _CLOSE for y in values[:i])
        for i, x in enumerate(values)
    ]
    step = min(0.14, 0.8 / max(1, *stacks))
    heights = [row + step * ((n + 1) // 2) * (-1) ** n for n in stacks]
    ax.scatter(
        values, heights, s=30, c=fill, marker=marker, alpha=0.8,
        edgecolors=_GREY if fill == 'white' else fill, clip_on=False, zorder=3,
    )  # fmt: skip
  ax.set_yticks(range(len(groups)), [label for label, *_ in groups])
  ax.set_ylim(len(groups) - 0.5, -0.5)
  ax.set_xlim(-2, 102)
  ax.grid(visible=False, axis='y')
  ax.tick_params(axis='y', length=0)
  return canvas


def _picture(title: str) -> tuple[figure.Figure, Any]:
  """Returns a new picture and its axes."""
  with matplotlib.rc_context(STYLE):
    canvas = figure.Figure(_SIZE, layout='constrained')
    ax = canvas.subplots()
    ax.set_title(title, loc='left', fontsize=10, fontweight='bold')
  return canvas, ax


def has_adaptation(run: study.Run) -> bool:
  """Returns True if the learner of a run goes on learning in another task."""
  return run.config['training'].get('adaptation') is not None


def _band(run: study.Run, key: str) -> pd.DataFrame:
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


def _value(run: study.Run, point: Mapping[str, Any], key: str) -> float | None:
  """Returns a figure of a point, with gains in units of the stake."""
  if key != 'gain' or point[key] is None:
    return point[key]
  if run.stake is None or run.stake.main.is_degenerate:
    return None
  return float(point[key]) / run.stake.main.estimate


def _draw_band(
    ax: Any, means: pd.DataFrame, colour: str, role: study.Role
) -> None:
  known = means.dropna()
  is_twin = role is study.Role.TWIN
  alpha = 0.08 if is_twin else 0.18
  ax.fill_between(
      known.index, known.low, known.high, color=colour, alpha=alpha, linewidth=0
  )
  style = '--' if is_twin else '-'
  ax.plot(means.index, means['mean'], style, color=colour, linewidth=1.5)

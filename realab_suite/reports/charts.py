"""Pictures in the page of a report, except its films: SVG charts and paths."""

import base64
from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import math
import pathlib
import tempfile
from typing import Any, NamedTuple, final

from matplotlib import lines
from matplotlib import patches
from matplotlib import ticker
import numpy as np

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import hacking
from realab_suite.evaluation import intervals
from realab_suite.experiments import tracking
from realab_suite.reports import chart_style
from realab_suite.reports import numbers
from realab_suite.reports import plots
from realab_suite.reports import replays
from realab_suite.reports import sweep_results

_Figures = Mapping[str, numbers.Figures]
_Styles = Mapping[str, chart_style.Style]

# Sizes in inches.
_ROW = 1.7
_MAP = 2.8
_MAP_COLUMNS = 4
# The axis of a figure is symlog above this ratio to its reference value.
_LARGEST_RATIO = 20.0
_DOOR = (0.71, 0.396, 0.114, 1.0)
_WALL = (0.769, 0.784, 0.812, 1.0)


@final
@dataclasses.dataclass(frozen=True)
class Picture:
  """A picture in the page.

  Attributes:
    title: Title of the picture.
    note: Explanation of the picture.
    uri: Data URI of the picture.
  """

  title: str
  note: str
  uri: str


def data_uri(kind: str, data: bytes) -> str:
  """Returns data of a MIME type as an address that contains it."""
  return f'data:{kind};base64,{base64.b64encode(data).decode()}'


def _svg(canvas: Any) -> str:
  return data_uri('image/svg+xml', chart_style.to_svg(canvas))


@final
@dataclasses.dataclass(frozen=True)
class Band:
  """Mean curve over seeds, with intervals.

  Attributes:
    steps: Numbers of control steps of training.
    mean: Mean over seeds at each of them.
    low: Lower bounds of the intervals; NaN with one seed.
    high: Upper bounds of the intervals.
  """

  steps: np.ndarray
  mean: np.ndarray
  low: np.ndarray
  high: np.ndarray


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
  parts: list[list[tuple[int, float]]] = [[]]
  ends, done, last = [0], 0, 0
  for step, number, value in points:
    if value is not None and number:
      parts[-1].append((number, value))
    last = step
    if step - done >= width:
      ends[-1] = done = step
      parts.append([])
      ends.append(step)
  rest = parts.pop()
  ends.pop()
  if rest and parts:
    parts[-1] += rest
    ends[-1] = last
  elif rest:
    parts, ends = [rest], [last]
  return {
      end: float(np.average([p[1] for p in part], weights=[p[0] for p in part]))
      for end, part in zip(ends, parts, strict=True)
      if sum(p[0] for p in part) >= fewest
  }


def band(
    curves: Mapping[int, Mapping[int, float]],
    bounds: intervals.Bounds = intervals.UNBOUNDED,
) -> Band:
  """Returns the mean over seeds and its interval at each step.

  A step counts if every seed that has reached it has a value there. Otherwise
  each step would show a different selection of seeds.

  Args:
    curves: Values by the number of control steps, for each seed.
    bounds: Bounds of the possible values.
  """
  known = {seed: c for seed, c in curves.items() if c}
  steps = [
      step
      for step in sorted({step for c in known.values() for step in c})
      if all(step in c or max(c) < step for c in known.values())
  ]
  found = [
      intervals.mean_interval(
          {seed: [c[step]] for seed, c in known.items() if step in c},
          bounds=bounds,
      )
      for step in steps
  ]
  return Band(
      np.array(steps, float),
      *(
          np.array([getattr(i, part) for i in found])
          for part in ('estimate', 'low', 'high')
      ),
  )


@final
class _Column(NamedTuple):
  """Column of the learning curves.

  Attributes:
    title: Name of the figure.
    key: Its key in a point of a curve.
    linear: Range in which a symlog axis is linear.
  """

  title: str
  key: str
  linear: float


_COLUMNS = (
    _Column('true return', 'true_return', 1.0),
    _Column('observed return (units)', 'observed_return', 10.0),
    _Column('relative gain', 'gain', hacking.SHARE_OF_STAKE),
)


def learning(
    sweep: sweep_results.Sweep, figures: _Figures, styles: _Styles
) -> Picture | None:
  """Returns the chart of returns and relative gain over training."""
  rows: dict[str, list[sweep_results.Run]] = {}
  for run in sweep.learned():
    # The twin is the last one.
    done = [one for one in (run, sweep.twin(run)) if one and one.is_done]
    if done:
      rows[run.name] = done
  if not rows:
    return None
  with chart_style.style_context():
    canvas, axes = chart_style.new_figure(
        len(rows), len(_COLUMNS), _ROW, sharex=True, sharey='col'
    )
    bands = {
        (name, column.key): [_band(run, column.key) for run in runs]
        for name, runs in rows.items()
        for column in _COLUMNS
    }
    for row, (name, runs) in zip(axes, rows.items(), strict=True):
      colour = styles[name].colour
      for ax, column in zip(row, _COLUMNS, strict=True):
        for run, one in zip(runs, bands[name, column.key], strict=True):
          _draw_band(ax, one, colour, is_twin=run.twin_of is not None)
        chart_style.tidy_axes(ax)
      baseline = figures.get(runs[0].baseline or '')
      if baseline is not None:
        row[0].axhline(
            baseline.summary.true_return.estimate,
            color=chart_style.GREY, linestyle=':', zorder=1,
        )  # fmt: skip
      row[-1].axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)
      row[0].set_ylabel(
          chart_style.shorten(name), color=colour, fontweight='bold'
      )
    true, observed, gain = (
        _largest(bands[name, column.key] for name in rows)
        for column in _COLUMNS
    )
    is_symlog = (
        False,
        observed > _LARGEST_RATIO * max(true, 1.0),
        gain > _LARGEST_RATIO * hacking.SHARE_OF_STAKE,
    )
    for ax, column, is_so in zip(axes[0], _COLUMNS, is_symlog, strict=True):
      if is_so:
        chart_style.set_symlog(ax.yaxis, ax.set_yscale, column.linear)
      title = f'{column.title}, symlog' if is_so else column.title
      ax.set_title(title, fontsize=10)
    for ax in axes.flat:
      # Chooses limits again: lines above have fixed those of the former scale.
      ax.margins(y=0.1)
    for ax in axes[-1]:
      ax.xaxis.set_major_formatter(ticker.FuncFormatter(_format_count))
      ax.xaxis.set_major_locator(ticker.MaxNLocator(5))
      ax.set_xlabel('control steps of training')
    chart_style.add_legend(canvas, _learning_legend(rows, figures, bands))
    uri = _svg(canvas)
  return Picture(
      'Learning curves',
      'Each point is a mean over the training episodes that ended since the'
      ' previous point; the interval is long enough for an episode in every'
      " world. The relative gain is what corruption adds to the learner's"
      ' objective, in units of the stake; episodes above'
      f' {hacking.SHARE_OF_STAKE:g} may be hacked. Observed returns are in the'
      ' units of each register. Points with episodes from fewer than half of'
      ' the worlds are omitted.',
      uri,
  )


def _band(run: sweep_results.Run, key: str) -> Band:
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
    means = [value for one in curves.values() for value in one.values()]
    bounds = comparison.return_bounds(run.rows, means)
  return band(curves, bounds)


def _value(
    run: sweep_results.Run, point: Mapping[str, Any], key: str
) -> float | None:
  """Returns a figure of a point, with gains in units of the stake."""
  if key != 'gain':
    return point[key]
  gain, stake = point['gain'], run.stake
  if gain is None or stake is None or stake.main.is_degenerate:
    return None
  return float(gain) / stake.main.estimate


def _draw_band(ax: Any, one: Band, colour: str, *, is_twin: bool) -> None:
  known = np.isfinite(one.low)
  ax.fill_between(
      one.steps[known], one.low[known], one.high[known], color=colour,
      alpha=0.08 if is_twin else 0.18, linewidth=0,
  )  # fmt: skip
  ax.plot(
      one.steps, one.mean, color=colour, linewidth=1.5,
      linestyle='--' if is_twin else '-',
  )  # fmt: skip


def _largest(bands: Iterable[Sequence[Band]]) -> float:
  values = [
      float(np.abs(one.mean).max())
      for of_design in bands
      for one in of_design
      if one.mean.size
  ]
  return max(values, default=0.0)


def _learning_legend(
    rows: Mapping[str, Sequence[sweep_results.Run]],
    figures: _Figures,
    bands: Mapping[tuple[str, str], Sequence[Band]],
) -> list[Any]:
  """Returns the entries of what the learning curves show."""
  runs = [run for of_design in rows.values() for run in of_design]
  ink = chart_style.INK
  handles: list[Any] = [lines.Line2D([], [], color=ink, label='design')]
  if any(run.twin_of is not None for run in runs):
    handles.append(
        lines.Line2D([], [], color=ink, ls='--', label='its secure twin')
    )
  if any(run.baseline in figures for run in runs):
    handles.append(
        lines.Line2D(
            [], [], color=chart_style.GREY, ls=':', label='its baseline'
        )
    )
  # A single seed has no interval.
  every = [one for of_design in bands.values() for one in of_design]
  if any(np.isfinite(one.low).any() for one in every):
    handles.append(
        patches.Patch(color=ink, alpha=0.15, label='95 % interval over seeds')
    )
  return handles


def _format_count(value: float, position: int | None = None) -> str:
  del position
  for size, letter in ((1e6, 'M'), (1e3, 'k')):
    if abs(value) >= size:
      return f'{value / size:g} {letter}'
  return f'{value:g}'


def plane(
    sweep: sweep_results.Sweep, figures: _Figures, styles: _Styles
) -> Picture | None:
  """Returns the chart of true return against hack rate."""
  baselines = {one.run.baseline for one in figures.values()}
  drawn = [
      (one, found)
      for name, one in figures.items()
      if (found := one.hacking) is not None
      if sweep.family(one.run) in styles
      if not one.run.is_scripted or name in baselines
  ]
  if not drawn:
    return None
  with chart_style.style_context():
    canvas, [[ax]] = chart_style.new_figure(1, 1, 4.6, 8.6)
    for one, found in drawn:
      own = styles[sweep.family(one.run)]
      colour, marker = own.colour, own.marker
      if one.run.is_scripted:
        colour, marker = chart_style.GREY, 'd'
      look = {
          'linestyle': '',
          'marker': marker,
          'color': colour,
          'mfc': 'white' if one.run.twin_of is not None else colour,
      }
      returns = comparison.by_seed(
          [row for row in one.run.rows if row.counts], 'true_return'
      )
      ax.plot(
          [100 * count.rate for count in found.by_seed.values()],
          [np.mean(returns[seed]) for seed in found.by_seed],
          markersize=3.5, alpha=chart_style.PALE, zorder=3, **look,
      )  # fmt: skip
      x, y = found.rate.scaled(100), one.summary.true_return
      if math.isfinite(x.low):
        ax.plot([x.low, x.high], [y.estimate] * 2, color=colour, lw=1.2)
      if math.isfinite(y.low):
        ax.plot([x.estimate] * 2, [y.low, y.high], color=colour, lw=1.2)
      ax.plot(x.estimate, y.estimate, markersize=9, zorder=4, **look)
    ax.set(xlabel='hack rate (%)', ylabel='true return', xlim=(-3, 103))
    chart_style.tidy_axes(ax)
    handles = [
        lines.Line2D(
            [], [], linestyle='', marker=own.marker, color=own.colour,
            label=name, markersize=7,
        )
        for name, own in styles.items()
    ]  # fmt: skip
    handles += [
        lines.Line2D([], [], linestyle='', marker='o', mfc='white',
                     color=chart_style.INK, label='hollow: secure twin'),
        lines.Line2D([], [], linestyle='', marker='d', color=chart_style.GREY,
                     label='scripted baseline'),
    ]  # fmt: skip
    chart_style.add_legend(canvas, handles)
    uri = _svg(canvas)
  return Picture(
      'True return against hack rate',
      'Small marks are seeds; large marks are means with 95 % intervals. Top'
      ' left: the design works as intended. Bottom right: it tampers. Bottom'
      ' left: it fails at the task without tampering.',
      uri,
  )


def maps(
    sweep: sweep_results.Sweep, figures: _Figures, styles: _Styles
) -> Picture | None:
  """Returns maps of the final positions of the blocks of registers."""
  learned = [one.run for one in figures.values() if not one.run.is_scripted]
  drawn = [run for run in learned if run.design.registers]
  if not drawn:
    return None
  walls = [
      shape
      for shape in replays.shapes(learned[0])
      if shape.kind in ('wall', 'barrier', 'door')
  ]
  low, high = plots.extent(walls)
  columns = min(len(drawn), _MAP_COLUMNS)
  rows = math.ceil(len(drawn) / columns)
  height = _MAP * (high[1] - low[1]) / (high[0] - low[0]) + 0.2
  with chart_style.style_context():
    canvas, axes = chart_style.new_figure(
        rows, columns, height, columns * _MAP + 0.3
    )
    for ax in axes.flat[len(drawn) :]:
      ax.set_axis_off()
    for ax, run in zip(axes.flat, drawn, strict=False):
      own = styles[sweep.family(run)]
      plots.draw_shapes(
          ax,
          [
              shape._replace(colour=_DOOR if shape.kind == 'door' else _WALL)
              for shape in walls
          ],
      )
      _draw_blocks(ax, run, own)
      ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
      ax.set(xticks=[], yticks=[])
      ax.set_title(
          chart_style.shorten(run.name),
          loc='left', color=own.colour, fontweight='bold',
      )  # fmt: skip
      for spine in ax.spines.values():
        spine.set_visible(False)
    _draw_scale(axes.flat[0], np.array([low[0] + 0.3, high[1] - 0.5]))
    ink = chart_style.INK
    handles = [
        patches.Patch(facecolor='none', edgecolor=ink, linestyle=':',
                      label='base block at the start'),
        lines.Line2D([], [], linestyle='', marker='o', color=ink,
                     alpha=chart_style.PALE,
                     label='base block at the end of an episode'),
        patches.Patch(color=_DOOR, label='door'),
    ]  # fmt: skip
    chart_style.add_legend(canvas, handles)
    uri = _svg(canvas)
  return Picture(
      'Final positions of registers',
      'The room from above. Each mark is the position of the base block of a'
      ' register at the end of an episode, for all seeds.',
      uri,
  )


def _draw_blocks(
    ax: Any, run: sweep_results.Run, style: chart_style.Style
) -> None:
  """Draws the base block of each register, over all seeds of a run."""
  size = max(one.block_size for one in run.design.registers.values())
  traces = list(run.traces.values())
  for name in traces[0]['registers']:
    start, end = (
        np.concatenate([t['registers'][name][when][:, 0] for t in traces])
        for when in ('start', 'end')
    )
    starts = np.unique(start.round(3), axis=0)
    middle = starts.mean(axis=0)
    if len(starts) == 1:
      plots.draw_block(
          ax, middle, size / 2, edgecolor=chart_style.INK, linestyle=':'
      )
    # Equal displacements are drawn once, and all of them as one line with gaps:
    # thousands of separate lines would make the page large.
    moves = np.unique(np.concatenate([start, end], axis=1).round(2), axis=0)
    start, end = moves[:, :2], moves[:, 2:]
    line = np.stack([start, end, np.full_like(end, np.nan)], axis=1)
    ax.plot(
        *line.reshape(-1, 2).T, color=style.colour, alpha=0.25, linewidth=0.6,
        zorder=2,
    )  # fmt: skip
    ax.plot(
        *end.T, linestyle='', marker=style.marker, markersize=3,
        color=style.colour, alpha=chart_style.PALE, markeredgewidth=0.6,
        mfc='white' if run.twin_of is not None else style.colour, zorder=3,
    )  # fmt: skip
    ax.annotate(
        name, middle, xytext=(0, -9), textcoords='offset points', fontsize=7,
        ha='center', va='top', zorder=5,
    )  # fmt: skip


def _draw_scale(ax: Any, centre: np.ndarray) -> None:
  """Draws a scale of one metre."""
  x, y = centre
  ax.plot([x, x + 1.0], [y, y], color=chart_style.INK, linewidth=2, zorder=6)
  ax.annotate(
      '1 m', (x + 0.5, y), xytext=(0, 3), textcoords='offset points',
      fontsize=7, ha='center', zorder=6,
  )  # fmt: skip


def paths(
    learned: Sequence[numbers.Figures],
) -> tuple[Picture | None, str | None]:
  """Returns a picture of typical episodes, and a problem.

  Either may be `None`. The problem is the error of the last run whose episode
  could not be replayed.
  """
  tracks: dict[str, tracking.Track] = {}
  problem = None
  for one in learned:
    row = replays.typical_row(one.run)
    if row is None:
      continue
    try:
      tracks[one.run.name] = replays.replay(one.run, row)
    except errors.RealabError as error:
      problem = f'{one.run.name}: {error}'
  if not tracks:
    return None, problem
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / 'paths.png'
    plots.draw_trajectories(tracks, path)
    data = path.read_bytes()
  picture = Picture(
      'Typical episodes',
      'Path of the agent and final positions of the blocks, in the episode of'
      ' median corruption of each design.',
      data_uri('image/png', data),
  )
  return picture, problem

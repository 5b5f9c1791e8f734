"""Plots: charts in the page of a report, and plots of single episodes.

Charts are SVG, plots of episodes are PNG. Equal figures give equal bytes.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import io
import math
import os
import pathlib
from typing import IO, Any, NamedTuple, final

import matplotlib
from matplotlib import cm
from matplotlib import collections
from matplotlib import colors
from matplotlib import figure
from matplotlib import lines
from matplotlib import patches
from matplotlib import patheffects
from matplotlib import ticker
import numpy as np

from realab_suite.entities import appearance
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import intervals
from realab_suite.reports import numbers

_Figures = Mapping[str, numbers.Figures]
_Styles = Mapping[str, 'Style']
_Tracks = Mapping[str, tracking.Track]

# Palette of Okabe and Ito, for readers with and without colour blindness.
# Yellow is left out because it is hard to see on white. Markers distinguish
# runs without colour.
_VERMILLION, _PURPLE = '#D55E00', '#CC79A7'
_ORANGE, _SKY_BLUE = '#E69F00', '#56B4E9'
_COLOURS = (
    '#0072B2', _VERMILLION, '#009E73', _PURPLE, _ORANGE, _SKY_BLUE, '#000000',
)  # fmt: skip
_MARKERS = ('o', 's', '^', 'D', 'v', 'P', 'X')
_GREY = '#767676'
_INK = '#222222'
_PALE = 0.55
_FLOOR = '0.95'
_DOOR = (0.71, 0.396, 0.114, 1.0)
_WALL = (0.769, 0.784, 0.812, 1.0)
_HALO = [patheffects.withStroke(linewidth=2.5, foreground='white')]
_DOTTED: Any = {'facecolor': 'none', 'edgecolor': _INK, 'linestyle': ':'}
# Sizes in inches, and numbers of columns.
_WIDTH, _ROW = 11.4, 1.7
_MAP, _MAP_COLUMNS = 2.8, 4
_PANELS, _WIDEST_PANEL, _PANEL_COLUMNS = 11.1, 5.0, 3
# Longest name that is drawn in full, in characters.
_LONGEST_NAME = 24
# The axis of a figure is symlog above this ratio to its reference value.
_LARGEST_RATIO = 20.0
# Blocks displaced by less than this count as not moved, in metres.
_UNMOVED = 0.05
# The pressed pad is a part of the post of the pad.
_HIDDEN = 'pressed_pad'
_TIDY_AXES: Any = {
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'grid.color': '#e6e6e6',
    'grid.linewidth': 0.6,
}
STYLE: Any = {
    **_TIDY_AXES,
    'svg.fonttype': 'none',  # Text stays small and searchable.
    'svg.hashsalt': 'realab_suite',
    'font.family': 'sans-serif',
    'font.size': 9,
    'axes.titlesize': 9,
    'axes.edgecolor': '#888888',
    'axes.labelcolor': _INK,
    'text.color': _INK,
    'text.parse_math': False,  # Names may contain dollar signs.
    'xtick.color': '#555555',
    'ytick.color': '#555555',
    'axes.unicode_minus': True,
}
"""Settings of Matplotlib for charts."""


@final
class Style(NamedTuple):
  """Colour and marker of a design, its twin and its baselines."""

  colour: str
  marker: str


def styles(names: Sequence[str]) -> dict[str, Style]:
  """Returns a distinct style for each name; it depends on their order only."""
  return {
      name: Style(
          _COLOURS[i % len(_COLOURS)],
          # With more designs than colours, markers make new pairs.
          _MARKERS[(i + i // len(_COLOURS)) % len(_MARKERS)],
      )
      for i, name in enumerate(names)
  }


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


def to_svg(canvas: figure.Figure) -> bytes:
  """Returns a figure as SVG; equal figures give equal bytes."""
  file = io.BytesIO()
  # Dates and versions would make equal figures differ.
  no_metadata = {key: None for key in ('Date', 'Creator', 'Format', 'Type')}
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


def _picture(
    title: str, note: str, canvas: figure.Figure, handles: list[Any]
) -> Picture:
  """Returns a figure with a legend as a picture of the page."""
  _add_legend(canvas, handles)
  return Picture(title, note, data_uri('image/svg+xml', to_svg(canvas)))


def _subplots(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[figure.Figure, Any]:
  """Returns a figure of a size in inches, and its array of axes."""
  canvas = figure.Figure(figsize=size, layout='constrained')
  return canvas, canvas.subplots(rows, columns, squeeze=False, **options)


def _handle(label: str, **options: Any) -> lines.Line2D:
  """Returns an entry of a legend that is a line or a marker."""
  return lines.Line2D([], [], label=label, **{'color': _INK, **options})


def _add_legend(canvas: figure.Figure, handles: list[Any]) -> None:
  """Adds a legend below a figure, in as many columns as fit."""
  longest = max(len(handle.get_label()) for handle in handles)
  # Approximate widths of a marker and of a letter, in inches.
  fit = int(canvas.get_figwidth() / (0.6 + 0.07 * longest))
  canvas.legend(
      handles=handles,
      loc='outside lower center',
      ncols=max(1, min(len(handles), fit)),
      frameon=False,
      fontsize=8.5,
  )


def _extent(
    shapes: Sequence[tracking.Shape],
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the lowest and the highest corner around shapes, with a margin."""
  corners = np.concatenate([shape.outline for shape in shapes])
  return corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1


def _draw_shapes(ax: Any, shapes: Iterable[tracking.Shape]) -> None:
  """Draws shapes from above, in their order."""
  for shape in shapes:
    ax.add_patch(
        patches.Polygon(shape.outline, facecolor=shape.colour, linewidth=0)
    )


def _draw_block(
    ax: Any, centre: np.ndarray, half_size: float, **options: Any
) -> None:
  """Draws a block from above, given its centre, `(2,)`, in metres."""
  x, y = centre - half_size
  edge = 2 * half_size
  options = {'facecolor': 'none', 'linewidth': 1.0, 'zorder': 4, **options}
  ax.add_patch(patches.Rectangle((x, y), edge, edge, **options))


def _shorten(name: str) -> str:
  """Shortens a name to the width of a chart."""
  return name if len(name) <= _LONGEST_NAME else f'{name[: _LONGEST_NAME - 1]}…'


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
  known = [(s, n, value) for s, n, value in points if n and value is not None]
  if known and (not ends or ends[-1] < known[-1][0]):
    ends[-1:] = [points[-1][0]]
  means = {}
  for begin, end in zip([0, *ends], ends, strict=False):
    counts = [n for s, n, _ in known if begin < s <= end]
    values = [value for s, _, value in known if begin < s <= end]
    if sum(counts) >= fewest:
      means[end] = float(np.average(values, weights=counts))
  return means


@final
class Band(NamedTuple):
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
  rows = []
  for step in sorted({step for c in known.values() for step in c}):
    if all(step in c or max(c) < step for c in known.values()):
      values = {seed: [c[step]] for seed, c in known.items() if step in c}
      mean = intervals.mean_interval(values, bounds=bounds)
      rows.append([step, mean.estimate, mean.low, mean.high])
  return Band(*np.array(rows, float).reshape(-1, 4).T)


# Title of each column of the learning curves, its key in a point of a curve,
# and the range in which a symlog axis is linear.
_COLUMNS = (
    ('true return', 'true_return', 1.0),
    ('observed return (units)', 'observed_return', 10.0),
    ('relative gain', 'gain', hacking.SHARE_OF_STAKE),
)


def learning(
    sweep: sweep_results.Sweep, figures: _Figures, styles: _Styles
) -> Picture | None:
  """Returns the chart of returns and relative gain over training."""
  rows = [
      done
      for run in sweep.learned()
      if (done := [r for r in (run, sweep.twin(run)) if r and r.is_done])
  ]
  if not rows:
    return None
  every: list[Band] = []
  with matplotlib.rc_context(STYLE):
    size = _WIDTH, len(rows) * _ROW + 0.6
    canvas, axes = _subplots(
        len(rows), len(_COLUMNS), size, sharex=True, sharey='col'
    )
    largest = [0.0] * len(_COLUMNS)
    for row, runs in zip(axes, rows, strict=True):
      name = sweep.family(runs[0])
      colour = styles[name].colour
      for i, (_, key, _) in enumerate(_COLUMNS):
        for run in runs:
          one = _band(run, key)
          _draw_band(row[i], one, colour, is_twin=run.twin_of is not None)
          largest[i] = max([largest[i], *np.abs(one.mean)])
          every.append(one)
      baseline = figures.get(runs[0].baseline or '')
      if baseline is not None:
        row[0].axhline(
            baseline.summary.true_return.estimate,
            color=_GREY, linestyle=':', zorder=1,
        )  # fmt: skip
      row[-1].axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)
      lengths = runs[0].config['training']
      if 'adaptation' in lengths:
        for ax in row:
          ax.axvline(lengths['steps'], color=_GREY, linestyle='-.', zorder=1)
      row[0].set_ylabel(_shorten(name), color=colour, fontweight='bold')
    references = (math.inf, max(largest[0], 1.0), hacking.SHARE_OF_STAKE)
    for ax, (title, _, linear), most, reference in zip(
        axes[0], _COLUMNS, largest, references, strict=True
    ):
      if most > _LARGEST_RATIO * reference:
        _set_symlog(ax, linear)
        title += ', symlog'
      ax.set_title(title, fontsize=10)
    for ax in axes.flat:
      # Chooses limits again: lines above have fixed those of the former scale.
      ax.margins(y=0.1)
    for ax in axes[-1]:
      ax.xaxis.set_major_formatter(ticker.EngFormatter())
      ax.xaxis.set_major_locator(ticker.MaxNLocator(5))
      ax.set_xlabel('control steps of training')
    handles: list[Any] = [_handle('design')]
    if any(len(runs) > 1 for runs in rows):
      handles.append(_handle('its secure twin', ls='--'))
    if any(run.baseline in figures for runs in rows for run in runs):
      handles.append(_handle('its baseline', color=_GREY, ls=':'))
    if any('adaptation' in runs[0].config['training'] for runs in rows):
      handles.append(_handle('adaptation begins', color=_GREY, ls='-.'))
    # A single seed has no interval.
    if any(np.isfinite(one.low).any() for one in every):
      label = '95 % interval over seeds'
      handles.append(patches.Patch(color=_INK, alpha=0.15, label=label))
    return _picture(
        'Learning curves',
        'Each point is a mean over the training episodes that ended since the'
        ' previous point; the interval is long enough for an episode in every'
        " world. The relative gain is what corruption adds to the learner's"
        ' objective, in units of the stake; episodes above'
        f' {hacking.SHARE_OF_STAKE:g} may be hacked. Observed returns are in'
        ' the units of each register. Points with episodes from fewer than half'
        ' of the worlds are omitted.',
        canvas,
        handles,
    )


def _band(run: sweep_results.Run, key: str) -> Band:
  """Returns the mean curve of a run for the key of a point."""

  def value(point: Mapping[str, Any]) -> float | None:
    """Returns a figure of a point, with gains in units of the stake."""
    found, stake = point[key], run.stake
    if key != 'gain' or found is None:
      return found
    if stake is None or stake.main.is_degenerate:
      return None
    return float(found) / stake.main.estimate

  # All worlds begin together, so at first their episodes also end together.
  # The reset takes one step more.
  num_envs = run.config['training']['num_envs']
  curves = {
      seed: curve(
          [
              (
                  one['step'],
                  one['num_episodes'] - one['num_invalid'],
                  value(one),
              )
              for one in points
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


def _set_symlog(ax: Any, threshold: float) -> None:
  """Makes the y axis logarithmic, and linear near zero, with few ticks."""
  ax.set_yscale('symlog', linthresh=threshold, linscale=0.6)
  # Powers of ten within the linear part would overlap.
  lowest = 10.0 ** math.ceil(math.log10(threshold))
  ax.yaxis.set_major_locator(
      ticker.SymmetricalLogLocator(base=10, linthresh=lowest)
  )
  ax.yaxis.set_minor_locator(ticker.NullLocator())
  ax.yaxis.set_major_formatter(ticker.StrMethodFormatter('{x:,.5g}'))


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
  with matplotlib.rc_context(STYLE):
    canvas, [[ax]] = _subplots(1, 1, (8.6, 5.2))
    for one, found in drawn:
      colour, marker = styles[sweep.family(one.run)]
      if one.run.is_scripted:
        colour, marker = _GREY, 'd'
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
          markersize=3.5, alpha=_PALE, zorder=3, **look,
      )  # fmt: skip
      x, y = found.rate.scaled(100), one.summary.true_return
      if math.isfinite(x.low):
        ax.plot([x.low, x.high], [y.estimate] * 2, color=colour, lw=1.2)
      if math.isfinite(y.low):
        ax.plot([x.estimate] * 2, [y.low, y.high], color=colour, lw=1.2)
      ax.plot(x.estimate, y.estimate, markersize=9, zorder=4, **look)
    ax.set(xlabel='hack rate (%)', ylabel='true return', xlim=(-3, 103))
    handles = [
        _handle(name, ls='', marker=own.marker, color=own.colour, markersize=7)
        for name, own in styles.items()
    ]
    handles += [
        _handle('hollow: secure twin', ls='', marker='o', mfc='white'),
        _handle('scripted baseline', ls='', marker='d', color=_GREY),
    ]
    return _picture(
        'True return against hack rate',
        'Small marks are seeds; large marks are means with 95 % intervals. Top'
        ' left: the design works as intended. Bottom right: it tampers. Bottom'
        ' left: it fails at the task without tampering.',
        canvas,
        handles,
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
      shape._replace(colour=_DOOR if shape.kind == 'door' else _WALL)
      for shape in replays.shapes(learned[0])
      if shape.kind in ('wall', 'barrier', 'door')
  ]
  low, high = _extent(walls)
  columns = min(len(drawn), _MAP_COLUMNS)
  rows = math.ceil(len(drawn) / columns)
  height = _MAP * (high[1] - low[1]) / (high[0] - low[0]) + 0.2
  size = columns * _MAP + 0.3, rows * height + 0.6
  with matplotlib.rc_context(STYLE):
    canvas, axes = _subplots(rows, columns, size)
    for ax in axes.flat[len(drawn) :]:
      ax.set_axis_off()
    for ax, run in zip(axes.flat, drawn, strict=False):
      own = styles[sweep.family(run)]
      _draw_shapes(ax, walls)
      _draw_blocks(ax, run, own)
      ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
      ax.set(xticks=[], yticks=[])
      ax.set_title(
          _shorten(run.name), loc='left', color=own.colour, fontweight='bold'
      )
      ax.spines[:].set_visible(False)
    _draw_scale(axes.flat[0], np.array([low[0] + 0.3, high[1] - 0.5]))
    base, end = 'base block at the start', 'base block at the end of an episode'
    return _picture(
        'Final positions of registers',
        'The room from above. Each mark is the position of the base block of a'
        ' register at the end of an episode, for all seeds.',
        canvas,
        [
            patches.Patch(label=base, **_DOTTED),
            _handle(end, ls='', marker='o', alpha=_PALE),
            patches.Patch(color=_DOOR, label='door'),
        ],
    )


def _draw_blocks(ax: Any, run: sweep_results.Run, style: Style) -> None:
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
      _draw_block(ax, middle, size / 2, **_DOTTED)
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
        color=style.colour, alpha=_PALE, markeredgewidth=0.6,
        mfc='white' if run.twin_of is not None else style.colour, zorder=3,
    )  # fmt: skip
    ax.annotate(
        name, middle, xytext=(0, -9), textcoords='offset points', fontsize=7,
        ha='center', va='top', zorder=5,
    )  # fmt: skip


def _draw_scale(ax: Any, centre: np.ndarray) -> None:
  """Draws a scale of one metre."""
  x, y = centre
  ax.plot([x, x + 1.0], [y, y], color=_INK, linewidth=2, zorder=6)
  ax.annotate(
      '1 m', (x + 0.5, y), xytext=(0, 3), textcoords='offset points',
      fontsize=7, ha='center', zorder=6,
  )  # fmt: skip


def draw(tracks: _Tracks, folder: pathlib.Path) -> None:
  """Draws the trajectories and the register values of some runs.

  Args:
    tracks: A track per run, all with the same world.
    folder: New folder for the PNG files.
  """
  folder.mkdir()
  draw_trajectories(tracks, folder / 'trajectories.png')
  if any(track.registers for track in tracks.values()):
    draw_time_line(tracks, folder / 'time_line.png')


def draw_trajectories(
    tracks: _Tracks, path: str | os.PathLike[str] | IO[bytes]
) -> None:
  """Draws the trajectories of some runs from above, side by side.

  Args:
    tracks: A track per run, all with the same world.
    path: PNG file to write, or a file that is open.
  """
  rows = math.ceil(len(tracks) / _PANEL_COLUMNS)
  columns = math.ceil(len(tracks) / rows)
  first = next(iter(tracks.values()))
  low, high = _extent(first.shapes)
  width = min(_PANELS / columns, _WIDEST_PANEL)
  title = 0.3
  height = width * (high[1] - low[1]) / (high[0] - low[0]) + title
  size = columns * width + 1.0, rows * height + 1.0
  canvas, axes = _subplots(rows, columns, size)
  longest = max(track.times[-1] for track in tracks.values())
  clock = cm.ScalarMappable(colors.Normalize(0.0, max(longest, 1.0)), 'viridis')
  for ax in axes.flat[len(tracks) :]:
    ax.set_axis_off()
  for ax, (run, track) in zip(axes.flat, tracks.items(), strict=False):
    _draw_world(ax, run, track, clock)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
    ax.set(xlabel='x (m)', ylabel='y (m)')
    ax.label_outer()
  canvas.colorbar(
      clock, ax=axes, label='time (s)', aspect=40, pad=0.01, shrink=0.8
  )
  _add_legend(canvas, _world_legend(tracks.values()))
  # Without a tight box, the topmost title is cut off if there are many panels.
  canvas.savefig(path, bbox_inches='tight', pad_inches=0.1)


def draw_time_line(tracks: _Tracks, path: str | os.PathLike[str]) -> None:
  """Draws clean contents, written values and readings of registers over time.

  Args:
    tracks: A track per run, all with the same registers, at least one.
    path: PNG file to write.
  """
  first = next(iter(tracks.values()))
  size = 12.0, 1.9 * len(tracks) + 1.0
  with matplotlib.rc_context(_TIDY_AXES):
    canvas, axes = _subplots(
        len(tracks), len(first.registers), size, sharex=True
    )
  for row, (run, track) in zip(axes, tracks.items(), strict=True):
    # The only title in its row, so that a long name has room.
    row[0].set_title(run, fontsize=10, fontweight='bold', loc='left')
    for ax, (name, register) in zip(row, track.registers.items(), strict=True):
      _draw_values(ax, track.times, register)
      ax.text(
          0.01, 0.97, f'{name} ({register.role} register)', fontsize=9,
          va='top', transform=ax.transAxes, path_effects=_HALO, zorder=6,
      )  # fmt: skip
    row[0].set_ylabel('value (units)')
  for ax in axes[-1]:
    ax.set_xlabel('time (s)')
  _add_legend(canvas, axes[0, 0].get_legend_handles_labels()[0])
  canvas.savefig(path)


def _draw_world(
    ax: Any, run: str, track: tracking.Track, clock: cm.ScalarMappable
) -> None:
  ax.set_facecolor(_FLOOR)
  _draw_shapes(ax, (one for one in track.shapes if one.kind != _HIDDEN))
  _draw_path(ax, track, clock)
  for name, register in track.registers.items():
    _draw_register(ax, name, register)
  ax.set_title(
      f'{run}\ntrue return {track.true_return:.1f},'
      f' observed {track.observed_return:.1f}',
      fontsize=10,
  )


def _draw_path(
    ax: Any, track: tracking.Track, clock: cm.ScalarMappable
) -> None:
  positions = np.array(track.positions)
  segments = np.stack([positions[:-1], positions[1:]], axis=1)
  ax.plot(*positions.T, color='white', linewidth=4.0, zorder=3)
  path = collections.LineCollection(
      list(segments), cmap=clock.cmap, norm=clock.norm, linewidth=2.0,
      capstyle='round', zorder=3,
  )  # fmt: skip
  path.set_array(track.times[1:])
  ax.add_collection(path)
  ax.plot(*positions[0], 'o', color='white', mec=_INK, ms=8, zorder=5)
  ax.plot(*positions[-1], 'X', color='white', mec=_INK, ms=9, zorder=5)


def _draw_register(
    ax: Any, name: str, register: tracking.RegisterTrack
) -> None:
  start, end = register.blocks[0], register.blocks[-1]
  classes = appearance.ROLE_COLOURS[register.role][-len(start) :]
  for before, after, colour in zip(start, end, classes, strict=True):
    _draw_block(ax, before, register.half_size, **_DOTTED)
    _draw_block(
        ax, after, register.half_size, facecolor=colour, edgecolor='white'
    )
    if np.linalg.norm(after - before) > _UNMOVED:
      ax.annotate(
          '', xy=after, xytext=before, zorder=6,
          arrowprops={
              'arrowstyle': '-|>', 'color': colour, 'linewidth': 1.5,
              'shrinkA': 0, 'shrinkB': 3, 'path_effects': _HALO,
          },
      )  # fmt: skip
  x, y = start[0]
  ax.text(
      x - register.half_size, y - 1.6 * register.half_size, name,
      fontsize=8, color=_INK, va='top', path_effects=_HALO, zorder=7,
  )  # fmt: skip


def _draw_values(
    ax: Any, times: np.ndarray, register: tracking.RegisterTrack
) -> None:
  applied, obstruction, permanent, reading = np.array(
      [
          register.applied, register.obstruction, register.permanent,
          register.reading,
      ]
  )  # fmt: skip
  ax.plot(times, register.clean, color='0.6', linewidth=4.0, label='clean')
  ax.plot(times, applied, color=_INK, linewidth=1.2, label='applied')
  ax.plot(
      times, reading, color=_VERMILLION, linewidth=1.2, linestyle='--',
      label='reading',
  )  # fmt: skip
  ends = (applied, applied + obstruction, applied + obstruction + permanent)
  for low, high, colour, alpha, label in zip(
      ends,
      (*ends[1:], reading),
      (_PURPLE, _ORANGE, _SKY_BLUE),
      (0.45, 0.45, 0.55),
      ('obstruction', 'permanent corruption', 'temporary corruption'),
      strict=True,
  ):
    ax.fill_between(
        times, low, high, color=colour, alpha=alpha, linewidth=0, label=label
    )
  ax.margins(x=0.01)
  ax.set_ylim(_limits([register.clean, register.applied, register.reading]))


def _limits(values: Any) -> tuple[float, float]:
  """Returns limits of an axis, with a minimum span."""
  low, high = np.nanmin(values), np.nanmax(values)
  middle, half = (low + high) / 2, max(0.6 * (high - low), 1.2)
  return middle - half, middle + half


def _world_legend(tracks: Iterable[tracking.Track]) -> list[Any]:
  """Returns the entries of everything that a track shows."""
  tracks = list(tracks)
  shapes = [shape for track in tracks for shape in track.shapes]
  kinds: dict[str, Any] = {one.kind: one.colour for one in shapes}
  handles: list[Any] = [
      patches.Patch(color=colour, label=_label(kind))
      for kind, colour in kinds.items()
      if kind != _HIDDEN
  ]
  handles += [
      _marker('o', 'avatar at the start'),
      _marker('X', 'avatar at the end'),
      patches.Patch(label='block at the start', **_DOTTED),
      _marker(r'$\rightarrow$', 'block displacement', color=_INK),
  ]
  roles = [one.role for track in tracks for one in track.registers.values()]
  for role in dict.fromkeys(roles):
    base, offset = appearance.ROLE_COLOURS[role]
    handles += [
        _marker('s', f'{role}: base block', color=base),
        _marker('s', f'{role}: offset block', color=offset),
    ]
  return handles


def _label(kind: str) -> str:
  """Returns a class of objects in words, such as 'large apple'."""
  # Objects without a class of their own, such as the plate around a pad.
  return 'other object' if kind == 'other' else kind.replace('_', ' ')


def _marker(marker: str, label: str, **options: Any) -> lines.Line2D:
  """Returns an entry of a legend that is a marker with an edge."""
  options = {'color': 'white', 'markeredgecolor': _INK, **options}
  return _handle(label, ls='', marker=marker, markersize=8, **options)

"""Plots: learning curves of a report, and trajectories of a comparison.

Curves are SVG, trajectories are PNG. Equal figures give equal bytes.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
import io
import math
import pathlib
from typing import Any, NamedTuple, final

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
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import intervals
from realab_suite.reports import numbers

_Figures = Mapping[str, numbers.Figures]
_Tracks = Mapping[str, tracking.Track]

# Palette of Okabe and Ito, for readers with and without colour blindness.
# Yellow is left out because it is hard to see on white.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_GREY = '#767676'
_INK = '#222222'
_FLOOR = '0.95'
_HALO = [patheffects.withStroke(linewidth=2.5, foreground='white')]
_DOTTED: Any = {'facecolor': 'none', 'edgecolor': _INK, 'linestyle': ':'}
# Sizes in inches, and numbers of columns.
_WIDTH, _ROW = 11.4, 1.7
_PANELS, _WIDEST_PANEL, _PANEL_COLUMNS = 11.1, 5.0, 3
# Longest name that is drawn in full, in characters.
_LONGEST_NAME = 24
# The axis of a figure is symlog above this ratio to its reference value.
_LARGEST_RATIO = 20.0
# Blocks displaced by less than this count as not moved, in metres.
_UNMOVED = 0.05
# The pressed pad is a part of the post of the pad.
_HIDDEN = 'pressed_pad'
STYLE: Any = {
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'grid.color': '#e6e6e6',
    'grid.linewidth': 0.6,
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
  seed_curves = {seed: c for seed, c in curves.items() if c}
  rows = []
  for step in sorted({step for c in seed_curves.values() for step in c}):
    if all(step in c or max(c) < step for c in seed_curves.values()):
      values = {seed: [c[step]] for seed, c in seed_curves.items() if step in c}
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


LEARNING_NOTE = (
    'Each point is a mean over the training episodes that ended since the'
    ' previous point; the interval is long enough for an episode in every'
    " world. The relative gain is what corruption adds to the learner's"
    ' objective, in units of the stake; episodes above'
    f' {hacking.SHARE_OF_STAKE:g} may be hacked. Observed returns are in the'
    ' units of each register. Points with episodes from fewer than half of the'
    ' worlds are omitted.'
)
"""Explanation of the chart `learning`."""


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
  bands: list[Band] = []
  with matplotlib.rc_context(STYLE):
    size = _WIDTH, len(rows) * _ROW + 0.6
    canvas, axes = _subplots(
        len(rows), len(_COLUMNS), size, sharex=True, sharey='col'
    )
    largest = [0.0] * len(_COLUMNS)
    for row, runs in zip(axes, rows, strict=True):
      name = sweep.family(runs[0])
      colour = run_colours[name]
      for i, (_, key, _) in enumerate(_COLUMNS):
        for run in runs:
          line = _band(run, key)
          _draw_band(row[i], line, colour, is_twin=run.twin_of is not None)
          largest[i] = max([largest[i], *np.abs(line.mean)])
          bands.append(line)
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
    if any(np.isfinite(one.low).any() for one in bands):
      label = '95 % interval over seeds'
      handles.append(patches.Patch(color=_INK, alpha=0.15, label=label))
    _add_legend(canvas, handles)
  return canvas


def _band(run: sweep_results.Run, key: str) -> Band:
  """Returns the mean curve of a run for the key of a point."""

  def value(point: Mapping[str, Any]) -> float | None:
    """Returns a figure of a point, with gains in units of the stake."""
    number, stake = point[key], run.stake
    if key != 'gain' or number is None:
      return number
    if stake is None or stake.main.is_degenerate:
      return None
    return float(number) / stake.main.estimate

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


def _draw_band(ax: Any, line: Band, colour: str, *, is_twin: bool) -> None:
  is_known = np.isfinite(line.low)
  ax.fill_between(
      line.steps[is_known], line.low[is_known], line.high[is_known],
      color=colour, alpha=0.08 if is_twin else 0.18, linewidth=0,
  )  # fmt: skip
  ax.plot(
      line.steps, line.mean, color=colour, linewidth=1.5,
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


def draw(tracks: _Tracks, folder: pathlib.Path) -> None:
  """Draws the trajectories of some runs from above, side by side.

  Args:
    tracks: A track per run, all with the same world.
    folder: New folder for the file `trajectories.png`.
  """
  folder.mkdir()
  rows = math.ceil(len(tracks) / _PANEL_COLUMNS)
  columns = math.ceil(len(tracks) / rows)
  first = next(iter(tracks.values()))
  corners = np.concatenate([shape.outline for shape in first.shapes])
  low, high = corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1
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
  canvas.savefig(
      folder / 'trajectories.png', bbox_inches='tight', pad_inches=0.1
  )


def _draw_world(
    ax: Any, run: str, track: tracking.Track, clock: cm.ScalarMappable
) -> None:
  ax.set_facecolor(_FLOOR)
  for shape in track.shapes:
    if shape.kind != _HIDDEN:
      ax.add_patch(
          patches.Polygon(shape.outline, facecolor=shape.colour, linewidth=0)
      )
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

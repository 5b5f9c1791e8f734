"""Plots of a report, as SVG: the same numbers give the same bytes."""

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import io
import math
from typing import Any, final

import matplotlib
from matplotlib import figure
from matplotlib import lines
from matplotlib import patches
from matplotlib import ticker
import numpy as np

from realab_suite.evaluation import intervals
from realab_suite.experiments import tracking

# Of Okabe and Ito, who chose them for eyes of every kind; without the yellow,
# which is hard to see on white. Markers tell runs apart without colour.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_MARKERS = ('o', 's', '^', 'D', 'v', 'P', 'X')
GREY = '#767676'
_INK = '#222222'
_WIDTH = 11.4
_ROW = 1.7
_MAP = 2.8
_MAP_COLUMNS = 4
# Letters of a name.
_ROOM = 24
_STYLE: Any = {
    'svg.fonttype': 'none',  # Text stays text: small, and it can be searched.
    'svg.hashsalt': 'realab_suite',
    'font.family': 'sans-serif',
    'font.size': 9,
    'axes.titlesize': 9,
    'axes.edgecolor': '#888888',
    'axes.labelcolor': _INK,
    'text.color': _INK,
    'text.parse_math': False,  # A name may have dollars in it.
    'xtick.color': '#555555',
    'ytick.color': '#555555',
    'axes.unicode_minus': True,
}
# Where observed returns exceed true ones so many times, the axis is symlog.
_DWARFED = 20.0
_PALE = 0.55


@final
@dataclasses.dataclass(frozen=True)
class Style:
  """How a design and all that belongs to it is drawn."""

  colour: str
  marker: str


def styles(names: Sequence[str]) -> dict[str, Style]:
  """Returns a style for each design, the same wherever it is shown."""
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
class Band:
  """A curve over seeds.

  Attributes:
    steps: Control steps of training.
    mean: Mean over seeds.
    low: Lower bounds of its intervals; nan with one seed.
    high: Upper bounds.
  """

  steps: np.ndarray
  mean: np.ndarray
  low: np.ndarray
  high: np.ndarray


def curve(
    points: Iterable[tuple[int, int, float | None]], width: int, fewest: int = 1
) -> dict[int, float]:
  """Returns the mean over at least so many steps, by where they end.

  Args:
    points: Up to which step, the number of episodes that ended since the point
      before, and their mean, where there is one.
    width: How many steps to take together. What is left in the end goes with
      those before.
    fewest: Steps in which fewer episodes ended are left out: in learning that
      begins in all worlds at once, those that end in between are odd ones.
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

  A step counts if every seed that has got so far has a figure there: others
  would show another selection of seeds at each step.

  Args:
    curves: Of each seed, a figure by the number of control steps.
    bounds: The possible values of the figure.
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
@dataclasses.dataclass(frozen=True)
class Learning:
  """How a design learned; each by whose it is: 'run' or 'twin'.

  Attributes:
    name: Of the run.
    true_return: True returns of the episodes that ended.
    observed_return: Observed returns.
    corruption: Signed corruption of the registers that its feedback is in,
      metres.
    baseline: The true return of the baseline, or `None`.
  """

  name: str
  true_return: Mapping[str, Band]
  observed_return: Mapping[str, Band]
  corruption: Mapping[str, Band]
  baseline: float | None


def draw_learning(
    designs: Sequence[Learning], style: Mapping[str, Style], margin: float
) -> bytes:
  """Draws returns and signed corruption against control steps of training.

  Args:
    designs: The designs, a row each.
    style: By design.
    margin: The smallest corruption that matters, metres.
  """
  with _styled():
    canvas, axes = _canvas(len(designs), 3, _ROW, sharex=True)
    for row, design in zip(axes, designs, strict=True):
      own = style[design.name]
      for ax, bands in zip(
          row,
          (design.true_return, design.observed_return, design.corruption),
          strict=True,
      ):
        for whose, one in bands.items():
          _draw_band(ax, one, own.colour, is_twin=whose == 'twin')
        _tidy(ax)
      if design.baseline is not None:
        row[0].axhline(design.baseline, color=GREY, linestyle=':', zorder=1)
      row[2].axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)
      row[0].set_ylabel(
          _short(design.name), color=own.colour, fontweight='bold'
      )
    observed = _largest(d.observed_return for d in designs)
    true = _largest(d.true_return for d in designs)
    corruption = _largest(d.corruption for d in designs)
    # For each column: what it shows, where it is linear, and whether it is so
    # everywhere.
    for i, (title, threshold, is_linear) in enumerate(
        (
            ('true return', 1.0, True),
            (
                'observed return (units)',
                10.0,
                observed <= _DWARFED * max(true, 1.0),
            ),
            ('signed corruption (m)', margin, corruption <= _DWARFED * margin),
        )
    ):
      column = [row[i] for row in axes]
      if not is_linear:
        title = f'{title}, symlog'
        for ax in column:
          _set_symlog(ax.yaxis, ax.set_yscale, threshold)
      column[0].set_title(title, fontsize=10)
      _share_limits(column)
    for ax in axes[-1]:
      ax.xaxis.set_major_formatter(ticker.FuncFormatter(_count))
      ax.xaxis.set_major_locator(ticker.MaxNLocator(5))
      ax.set_xlabel('control steps of training')
    handles = [
        lines.Line2D([], [], color=_INK, label='design'),
        lines.Line2D([], [], color=_INK, ls='--', label='its secure twin'),
        lines.Line2D([], [], color=GREY, ls=':', label='its baseline'),
        patches.Patch(color=_INK, alpha=0.15, label='95 % interval over seeds'),
    ]
    _legend(canvas, handles)
    return _svg(canvas)


@final
@dataclasses.dataclass(frozen=True)
class Point:
  """A run in the plane of true return against corruption.

  Attributes:
    name: Of the run.
    family: The design whose style it has.
    kind: 'run', 'twin' or 'baseline'.
    by_seed: (corruption in metres, true return) of each seed.
    corruption: Mean and interval, metres.
    true_return: Mean and interval.
  """

  name: str
  family: str
  kind: str
  by_seed: Sequence[tuple[float, float]]
  corruption: intervals.Interval
  true_return: intervals.Interval


def draw_plane(
    points: Sequence[Point], style: Mapping[str, Style], margin: float
) -> bytes:
  """Draws runs by what they corrupted and what they achieved.

  Args:
    points: The runs.
    style: By design.
    margin: The smallest corruption that matters, metres.
  """
  with _styled():
    canvas, [[ax]] = _canvas(1, 1, 4.6, 8.6)
    ax.axvspan(-1.0, margin, color='#f2f2f2', zorder=0)
    # What is smaller than the margin does not matter: the axis is linear there.
    _set_symlog(ax.xaxis, ax.set_xscale, margin)
    for point in points:
      own = style[point.family]
      colour = GREY if point.kind == 'baseline' else own.colour
      face = 'white' if point.kind == 'twin' else colour
      marker = 'd' if point.kind == 'baseline' else own.marker
      seeds = np.array(point.by_seed)
      ax.plot(
          *seeds.T, linestyle='', marker=marker, markersize=3.5, mfc=face,
          color=colour, alpha=_PALE, zorder=3,
      )  # fmt: skip
      x, y = point.corruption, point.true_return
      for where, bounds in (('x', x), ('y', y)):
        if math.isfinite(bounds.low):
          ends = [bounds.low, bounds.high]
          other = [y.estimate if where == 'x' else x.estimate] * 2
          pair = (ends, other) if where == 'x' else (other, ends)
          ax.plot(*pair, color=colour, linewidth=1.2, zorder=2)
      ax.plot(
          x.estimate, y.estimate, linestyle='', marker=marker, markersize=9,
          mfc=face, color=colour, zorder=4,
      )  # fmt: skip
    ax.set(xlabel='corruption (m, symlog)', ylabel='true return')
    largest = max(max(x for x, _ in p.by_seed) for p in points)
    ax.set_xlim(-0.01, max(1.25 * largest, 4 * margin))
    ax.xaxis.set_major_formatter(ticker.FuncFormatter(_plain))
    _tidy(ax)
    handles = [
        lines.Line2D(
            [], [], linestyle='', marker=own.marker, color=own.colour,
            label=name, markersize=7,
        )
        for name, own in style.items()
    ]  # fmt: skip
    handles += [
        lines.Line2D([], [], linestyle='', marker='o', mfc='white',
                     color=_INK, label='hollow: secure twin'),
        lines.Line2D([], [], linestyle='', marker='d', color=GREY,
                     label='scripted baseline'),
    ]  # fmt: skip
    _legend(canvas, handles)
    return _svg(canvas)


@final
@dataclasses.dataclass(frozen=True)
class Map:
  """Where the base blocks of a run stood in the end, seen from above.

  Attributes:
    name: Of the run.
    family: The design whose style it has.
    is_twin: Whether the run is a secure twin.
    blocks: For each register, where its first block was when episodes began
      and where it ended, each `(episodes, 2)`, metres.
    half_size: Half the length of an edge of a block, metres.
  """

  name: str
  family: str
  is_twin: bool
  blocks: Mapping[str, tuple[np.ndarray, np.ndarray]]
  half_size: float


def draw_maps(
    maps: Sequence[Map],
    shapes: Sequence[tracking.Shape],
    style: Mapping[str, Style],
) -> bytes:
  """Draws where registers were moved to."""
  columns = min(len(maps), _MAP_COLUMNS)
  rows = math.ceil(len(maps) / columns)
  walls = [s for s in shapes if s.kind in ('wall', 'barrier', 'door')]
  corners = np.concatenate([shape.outline for shape in walls])
  low, high = corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1
  height = _MAP * (high[1] - low[1]) / (high[0] - low[0]) + 0.2
  with _styled():
    canvas, axes = _canvas(rows, columns, height, columns * _MAP + 0.3)
    for ax in axes.flat[len(maps) :]:
      ax.set_axis_off()
    for ax, one in zip(axes.flat, maps, strict=False):
      own = style[one.family]
      for shape in walls:
        colour = '#b5651d' if shape.kind == 'door' else '#c4c8cf'
        ax.add_patch(
            patches.Polygon(shape.outline, facecolor=colour, linewidth=0)
        )
      for name, (start, end) in one.blocks.items():
        _draw_blocks(ax, name, start, end, one, own)
      ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
      ax.set(xticks=[], yticks=[])
      ax.set_title(
          _short(one.name), loc='left', color=own.colour, fontweight='bold'
      )
      for spine in ax.spines.values():
        spine.set_visible(False)
    _draw_scale(axes.flat[0], np.array([low[0] + 0.3, high[1] - 0.5]))
    handles = [
        patches.Patch(facecolor='none', edgecolor=_INK, linestyle=':',
                      label='base block at the start'),
        lines.Line2D([], [], linestyle='', marker='o', color=_INK, alpha=_PALE,
                     label='base block at the end of an episode'),
        patches.Patch(color='#b5651d', label='door'),
    ]  # fmt: skip
    _legend(canvas, handles)
    return _svg(canvas)


def _draw_blocks(
    ax: Any,
    name: str,
    start: np.ndarray,
    end: np.ndarray,
    one: Map,
    style: Style,
) -> None:
  places = np.unique(start.round(3), axis=0)
  middle = places.mean(axis=0)
  edge = 2 * one.half_size
  if len(places) == 1:
    ax.add_patch(
        patches.Rectangle(
            middle - one.half_size, edge, edge, facecolor='none',
            edgecolor=_INK, linestyle=':', zorder=4,
        )
    )  # fmt: skip
  # Ways that style alike are drawn once, and all as one line with gaps: a
  # thousand of their own would make the page heavy.
  ways = np.unique(np.concatenate([start, end], axis=1).round(2), axis=0)
  here, end = ways[:, :2], ways[:, 2:]
  line = np.stack([here, end, np.full_like(end, np.nan)], axis=1)
  ax.plot(
      *line.reshape(-1, 2).T, color=style.colour, alpha=0.25, linewidth=0.6,
      zorder=2,
  )  # fmt: skip
  ax.plot(
      *end.T, linestyle='', marker=style.marker, markersize=3,
      color=style.colour, mfc='white' if one.is_twin else style.colour,
      alpha=_PALE, markeredgewidth=0.6, zorder=3,
  )  # fmt: skip
  ax.annotate(
      name, middle, xytext=(0, -9), textcoords='offset points', fontsize=7,
      ha='center', va='top', zorder=5,
  )  # fmt: skip


def _draw_scale(ax: Any, centre: np.ndarray) -> None:
  """Draws how long a metre is."""
  x, y = centre
  ax.plot([x, x + 1.0], [y, y], color=_INK, linewidth=2, zorder=6)
  ax.annotate(
      '1 m', (x + 0.5, y), xytext=(0, 3), textcoords='offset points',
      fontsize=7, ha='center', zorder=6,
  )  # fmt: skip


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


def _largest(curves: Iterable[Mapping[str, Band]]) -> float:
  values = [
      float(np.abs(one.mean).max())
      for bands in curves
      for one in bands.values()
      if one.mean.size
  ]
  return max(values, default=0.0)


def _set_symlog(axis: Any, set_scale: Any, threshold: float) -> None:
  """Makes an axis logarithmic, but linear near zero, with few plain ticks."""
  set_scale('symlog', linthresh=threshold, linscale=0.6)
  # Powers of ten within the linear part would be on top of each other.
  lowest = 10.0 ** math.ceil(math.log10(threshold))
  axis.set_major_locator(
      ticker.SymmetricalLogLocator(base=10, linthresh=lowest)
  )
  axis.set_minor_locator(ticker.NullLocator())
  axis.set_major_formatter(ticker.FuncFormatter(_plain))


def _share_limits(axes: Sequence[Any]) -> None:
  limits = np.array([ax.get_ylim() for ax in axes])
  for ax in axes:
    ax.set_ylim(limits[:, 0].min(), limits[:, 1].max())


def _short(name: str) -> str:
  """Returns as much of a name as there is room for."""
  return name if len(name) <= _ROOM else f'{name[: _ROOM - 1]}…'


def _plain(value: float, position: int | None = None) -> str:
  del position
  return f'{value:,.5g}'.replace('-', '\N{MINUS SIGN}')


def _count(value: float, position: int | None = None) -> str:
  del position
  for size, letter in ((1e6, 'M'), (1e3, 'k')):
    if abs(value) >= size:
      return f'{value / size:g} {letter}'
  return f'{value:g}'


def _tidy(ax: Any) -> None:
  ax.grid(color='#e6e6e6', linewidth=0.6)
  ax.set_axisbelow(True)
  for side in ('top', 'right'):
    ax.spines[side].set_visible(False)


def _legend(canvas: figure.Figure, handles: list[Any]) -> None:
  longest = max(len(handle.get_label()) for handle in handles)
  # Inches: about so wide are the mark and a letter.
  fit = int(canvas.get_figwidth() / (0.6 + 0.07 * longest))
  canvas.legend(
      handles=handles,
      loc='outside lower center',
      ncols=max(1, min(len(handles), fit)),
      frameon=False,
      fontsize=8.5,
  )


def _styled() -> Any:
  return matplotlib.rc_context(_STYLE)


def _canvas(
    rows: int,
    columns: int,
    height: float,
    width: float = _WIDTH,
    **options: Any,
) -> tuple[figure.Figure, Any]:
  canvas = figure.Figure(
      figsize=(width, rows * height + 0.6), layout='constrained'
  )
  return canvas, canvas.subplots(rows, columns, squeeze=False, **options)


def _svg(canvas: figure.Figure) -> bytes:
  file = io.BytesIO()
  # Nothing about when, or by which version: that is no part of a figure.
  nothing = {key: None for key in ('Date', 'Creator', 'Format', 'Type')}
  canvas.savefig(
      file, format='svg', metadata=nothing, bbox_inches='tight', pad_inches=0.05
  )
  data = file.getvalue()
  # Without the document type, which is an address in the net.
  return data[data.index(b'<svg') :]

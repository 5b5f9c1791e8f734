"""Chart of returns and relative gain against training steps."""

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
from typing import Any, final

from matplotlib import lines
from matplotlib import patches
from matplotlib import ticker
import numpy as np

from realab_suite.evaluation import intervals
from realab_suite.reports import chart_style

_ROW = 1.7
# The axis of a figure is symlog above this ratio to its reference value.
_LARGEST_RATIO = 20.0


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
    width: Smallest number of steps in a window. A rest that is shorter belongs
      to the last window.
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
@dataclasses.dataclass(frozen=True)
class Learning:
  """Learning curves of a design, with the keys 'run' and 'twin'.

  Attributes:
    name: Name of the run.
    true_return: True returns of the episodes that ended.
    observed_return: Observed returns of these episodes.
    gain: Relative gains of these episodes.
    baseline: True return of the baseline, or `None`.
  """

  name: str
  true_return: Mapping[str, Band]
  observed_return: Mapping[str, Band]
  gain: Mapping[str, Band]
  baseline: float | None


def draw(
    designs: Sequence[Learning],
    style: Mapping[str, chart_style.Style],
    limit: float,
) -> bytes:
  """Draws returns and relative gain against control steps of training.

  Args:
    designs: Designs to draw, a row each.
    style: Style of each design.
    limit: Smallest relative gain that matters.
  """
  with chart_style.style_context():
    canvas, axes = chart_style.new_figure(len(designs), 3, _ROW, sharex=True)
    for row, design in zip(axes, designs, strict=True):
      own = style[design.name]
      for ax, bands in zip(
          row,
          (design.true_return, design.observed_return, design.gain),
          strict=True,
      ):
        for whose, one in bands.items():
          _draw_band(ax, one, own.colour, is_twin=whose == 'twin')
        chart_style.tidy_axes(ax)
      if design.baseline is not None:
        row[0].axhline(
            design.baseline, color=chart_style.GREY, linestyle=':', zorder=1
        )
      row[2].axhline(0.0, color='#bbbbbb', linewidth=0.8, zorder=0)
      row[0].set_ylabel(
          chart_style.shorten(design.name), color=own.colour, fontweight='bold'
      )
    observed = _largest(d.observed_return for d in designs)
    true = _largest(d.true_return for d in designs)
    gain = _largest(d.gain for d in designs)
    # Each column has a title, a range in which its axis is linear, and a flag
    # that makes all of the axis linear.
    for i, (title, threshold, is_linear) in enumerate(
        (
            ('true return', 1.0, True),
            (
                'observed return (units)',
                10.0,
                observed <= _LARGEST_RATIO * max(true, 1.0),
            ),
            ('relative gain', limit, gain <= _LARGEST_RATIO * limit),
        )
    ):
      column = [row[i] for row in axes]
      if not is_linear:
        title = f'{title}, symlog'
        for ax in column:
          chart_style.set_symlog(ax.yaxis, ax.set_yscale, threshold)
      column[0].set_title(title, fontsize=10)
      _share_limits(column)
    for ax in axes[-1]:
      ax.xaxis.set_major_formatter(ticker.FuncFormatter(_format_count))
      ax.xaxis.set_major_locator(ticker.MaxNLocator(5))
      ax.set_xlabel('control steps of training')
    handles = [
        lines.Line2D([], [], color=chart_style.INK, label='design'),
        lines.Line2D(
            [], [], color=chart_style.INK, ls='--', label='its secure twin'
        ),
        lines.Line2D(
            [], [], color=chart_style.GREY, ls=':', label='its baseline'
        ),
        patches.Patch(
            color=chart_style.INK, alpha=0.15, label='95 % interval over seeds'
        ),
    ]
    chart_style.add_legend(canvas, handles)
    return chart_style.to_svg(canvas)


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


def _share_limits(axes: Sequence[Any]) -> None:
  limits = np.array([ax.get_ylim() for ax in axes])
  for ax in axes:
    ax.set_ylim(limits[:, 0].min(), limits[:, 1].max())


def _format_count(value: float, position: int | None = None) -> str:
  del position
  for size, letter in ((1e6, 'M'), (1e3, 'k')):
    if abs(value) >= size:
      return f'{value / size:g} {letter}'
  return f'{value:g}'

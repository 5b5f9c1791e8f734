"""Chart of true return against corruption."""

from collections.abc import Mapping, Sequence
import dataclasses
import math
from typing import final

from matplotlib import lines
from matplotlib import ticker
import numpy as np

from realab_suite.evaluation import intervals
from realab_suite.reports import chart_style


@final
@dataclasses.dataclass(frozen=True)
class Point:
  """A run in the plane of true return against corruption.

  Attributes:
    name: Name of the run.
    family: Design whose style the run has.
    kind: 'run', 'twin' or 'baseline'.
    by_seed: Corruption in metres and true return of each seed.
    corruption: Mean and interval of the corruption, in metres.
    true_return: Mean and interval of the true return.
  """

  name: str
  family: str
  kind: str
  by_seed: Sequence[tuple[float, float]]
  corruption: intervals.Interval
  true_return: intervals.Interval


def draw(
    points: Sequence[Point],
    style: Mapping[str, chart_style.Style],
    margin: float,
) -> bytes:
  """Draws the true return of runs against their corruption.

  Args:
    points: Runs to draw.
    style: Style of each design.
    margin: Smallest corruption that matters, in metres.
  """
  with chart_style.style_context():
    canvas, [[ax]] = chart_style.new_figure(1, 1, 4.6, 8.6)
    ax.axvspan(-1.0, margin, color='#f2f2f2', zorder=0)
    # Corruption below the margin does not matter, so the axis is linear there.
    chart_style.set_symlog(ax.xaxis, ax.set_xscale, margin)
    for point in points:
      own = style[point.family]
      colour = chart_style.GREY if point.kind == 'baseline' else own.colour
      face = 'white' if point.kind == 'twin' else colour
      marker = 'd' if point.kind == 'baseline' else own.marker
      seeds = np.array(point.by_seed)
      ax.plot(
          *seeds.T, linestyle='', marker=marker, markersize=3.5, mfc=face,
          color=colour, alpha=chart_style.PALE, zorder=3,
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
    # Bounds of an interval that is not known are nan.
    corruptions = [
        x
        for point in points
        for x in (*(x for x, _ in point.by_seed), point.corruption.high)
        if math.isfinite(x)
    ]
    largest = max(corruptions)
    ax.set_xlim(-0.01, max(1.25 * largest, 4 * margin))
    ax.xaxis.set_major_formatter(
        ticker.FuncFormatter(chart_style.format_number)
    )
    chart_style.tidy_axes(ax)
    handles = [
        lines.Line2D(
            [], [], linestyle='', marker=own.marker, color=own.colour,
            label=name, markersize=7,
        )
        for name, own in style.items()
    ]  # fmt: skip
    handles += [
        lines.Line2D([], [], linestyle='', marker='o', mfc='white',
                     color=chart_style.INK, label='hollow: secure twin'),
        lines.Line2D([], [], linestyle='', marker='d', color=chart_style.GREY,
                     label='scripted baseline'),
    ]  # fmt: skip
    chart_style.add_legend(canvas, handles)
    return chart_style.to_svg(canvas)

"""Chart of true return against hack rate."""

from collections.abc import Mapping, Sequence
import dataclasses
import math
from typing import final

from matplotlib import lines
import numpy as np

from realab_suite.evaluation import intervals
from realab_suite.reports import chart_style


@final
@dataclasses.dataclass(frozen=True)
class Point:
  """A run in the plane of true return against hack rate.

  Attributes:
    name: Name of the run.
    family: Design whose style the run has.
    kind: 'run', 'twin' or 'baseline'.
    by_seed: Hack rate in per cent and true return of each seed.
    hack_rate: Mean and interval of the hack rate, in per cent.
    true_return: Mean and interval of the true return.
  """

  name: str
  family: str
  kind: str
  by_seed: Sequence[tuple[float, float]]
  hack_rate: intervals.Interval
  true_return: intervals.Interval


def draw(
    points: Sequence[Point], style: Mapping[str, chart_style.Style]
) -> bytes:
  """Draws the true return of runs against their hack rate.

  Args:
    points: Runs to draw.
    style: Style of each design.
  """
  with chart_style.style_context():
    canvas, [[ax]] = chart_style.new_figure(1, 1, 4.6, 8.6)
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
      x, y = point.hack_rate, point.true_return
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
    ax.set(xlabel='hack rate (%)', ylabel='true return', xlim=(-3, 103))
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

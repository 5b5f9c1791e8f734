"""Chart of the corruption in episodes by cause: the agent and the world."""

from collections.abc import Mapping
from typing import Any

from matplotlib import lines
from matplotlib import patches
import numpy as np

from realab_suite.evaluation import attribution_metrics
from realab_suite.reports import chart_style

_HEIGHT = 1.9
_AGENT = '#D55E00'
_WORLD = '#56B4E9'
# Smallest range of the axis, in units.
_LEAST = 1.0


def draw(episodes: Mapping[str, attribution_metrics.Attribution]) -> bytes:
  """Draws the corruption of registers over time, stacked by cause.

  Args:
    episodes: Attribution of an episode of each run, at least one.

  Returns:
    The chart as SVG, with a row for each register that the learner of a run
    consumes, or for all of its registers if there is none.
  """
  rows = [
      (run, name, one)
      for run, one in episodes.items()
      for name in one.consumed or one.registers
  ]
  with chart_style.style_context():
    canvas, axes = chart_style.new_figure(len(rows), 1, _HEIGHT, sharex=True)
    for [ax], (run, name, one) in zip(axes, rows, strict=True):
      _draw_register(ax, one, name)
      paid = ' (pays)' if name in one.directions else ''
      ax.set_title(f'{run}: {name}{paid}', loc='left')
      ax.set_ylabel('corruption (units)')
    axes[-1][0].set_xlabel('time (s)')
    chart_style.add_legend(canvas, _legend())
    return chart_style.to_svg(canvas)


def _draw_register(
    ax: Any, attribution: attribution_metrics.Attribution, name: str
) -> None:
  register = attribution.registers[name]
  times = attribution.timestep * np.arange(len(register.total) + 1)
  # Every episode begins without corruption.
  agent, world, total = (
      np.append(0.0, values)
      for values in (register.agent, register.world, register.total)
  )
  # Shares of opposite signs are on opposite sides of zero.
  start = np.where(agent * world > 0, world, 0.0)
  ax.fill_between(times, 0.0, world, color=_WORLD, alpha=0.6, linewidth=0)
  ax.fill_between(
      times, start, start + agent, color=_AGENT, alpha=0.6, linewidth=0
  )
  ax.plot(times, total, color=chart_style.INK, linewidth=1.0)
  drawn = np.concatenate([world, start + agent])
  low, high = drawn.min(), drawn.max()
  room = max(0.1 * (high - low), (_LEAST - (high - low)) / 2)
  ax.set_ylim(low - room, high + room)
  ax.margins(x=0.01)
  chart_style.tidy_axes(ax)


def _legend() -> list[Any]:
  return [
      patches.Patch(color=_AGENT, alpha=0.6, label="agent's part"),
      patches.Patch(color=_WORLD, alpha=0.6, label="world's part"),
      lines.Line2D([], [], color=chart_style.INK, label='total'),
  ]

"""Chart of the corruption in an episode by cause: the agent and the world."""

from typing import Any

from matplotlib import figure
from matplotlib import lines
from matplotlib import patches
import numpy as np

from realab_suite.evaluation import attribution_metrics
from realab_suite.reports import chart_style

_HEIGHT = 1.9
_AGENT = '#D55E00'
_WORLD = '#56B4E9'
_ACCIDENTAL = '#CC79A7'
# Smallest range of the axis, in units.
_LEAST = 1.0


def draw(attribution: attribution_metrics.Attribution) -> figure.Figure:
  """Draws the corruption of registers over time, stacked by cause.

  Args:
    attribution: Attribution of an episode.

  Returns:
    A figure with a row for each register that the learner consumes, or for all
    registers if there is none.
  """
  names = attribution.consumed or tuple(attribution.registers)
  with chart_style.style_context():
    canvas, rows = chart_style.new_figure(
        max(1, len(names)), 1, _HEIGHT, sharex=True
    )
    for [ax], name in zip(rows, names, strict=False):
      _draw_register(ax, attribution, name)
      paid = name in attribution.directions
      ax.set_title(f'{name}{" (pays)" if paid else ""}', loc='left')
      ax.set_ylabel('corruption (units)')
    rows[-1][0].set_xlabel('time (s)')
    chart_style.add_legend(canvas, _legend(attribution.baseline))
  return canvas


def _draw_register(
    ax: Any, attribution: attribution_metrics.Attribution, name: str
) -> None:
  register = attribution.registers[name]
  times = attribution.timestep * np.arange(len(register.total) + 1)
  # Every episode begins without corruption.
  agent, world, total, accidental = (
      np.append(0.0, values)
      for values in (
          register.agent,
          register.world,
          register.total,
          register.accidental,
      )
  )
  # Shares of opposite signs are on opposite sides of zero.
  start = np.where(agent * world > 0, world, 0.0)
  ax.fill_between(times, 0.0, world, color=_WORLD, alpha=0.6, linewidth=0)
  ax.fill_between(
      times, start, start + agent, color=_AGENT, alpha=0.6, linewidth=0
  )
  ax.plot(times, total, color=chart_style.INK, linewidth=1.0)
  ax.plot(times, accidental, color=_ACCIDENTAL, linewidth=1.2, linestyle='--')
  drawn = np.concatenate([world, start + agent, accidental])
  low, high = drawn.min(), drawn.max()
  room = 0.1 * max(high - low, _LEAST)
  ax.set_ylim(low - room, high + room)
  ax.margins(x=0.01)
  chart_style.tidy_axes(ax)


def _legend(baseline: str) -> list[Any]:
  return [
      patches.Patch(color=_AGENT, alpha=0.6, label="agent's share"),
      patches.Patch(color=_WORLD, alpha=0.6, label="world's share"),
      lines.Line2D([], [], color=chart_style.INK, label='total'),
      lines.Line2D(
          [], [], color=_ACCIDENTAL, linestyle='--',
          label=f'accidental (one step of {baseline})',
      ),
  ]  # fmt: skip

"""Maps of the final positions of blocks, seen from above."""

from collections.abc import Mapping, Sequence
import dataclasses
import math
from typing import Any, final

from matplotlib import lines
from matplotlib import patches
import numpy as np

from realab_suite.experiments import tracking
from realab_suite.reports import chart_style

_MAP = 2.8
_MAP_COLUMNS = 4


@final
@dataclasses.dataclass(frozen=True)
class Map:
  """Positions of the base blocks of a run at the end of its episodes.

  Attributes:
    name: Name of the run.
    family: Design whose style the run has.
    is_twin: True if the run is a secure twin.
    blocks: Positions of the first block of each register at the start and at
      the end of episodes, both of shape `(episodes, 2)`, in metres.
    half_size: Half the edge length of a block, in metres.
  """

  name: str
  family: str
  is_twin: bool
  blocks: Mapping[str, tuple[np.ndarray, np.ndarray]]
  half_size: float


def draw(
    maps: Sequence[Map],
    shapes: Sequence[tracking.Shape],
    style: Mapping[str, chart_style.Style],
) -> bytes:
  """Draws a map for each run."""
  columns = min(len(maps), _MAP_COLUMNS)
  rows = math.ceil(len(maps) / columns)
  walls = [s for s in shapes if s.kind in ('wall', 'barrier', 'door')]
  corners = np.concatenate([shape.outline for shape in walls])
  low, high = corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1
  height = _MAP * (high[1] - low[1]) / (high[0] - low[0]) + 0.2
  with chart_style.style_context():
    canvas, axes = chart_style.new_figure(
        rows, columns, height, columns * _MAP + 0.3
    )
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
          chart_style.shorten(one.name),
          loc='left',
          color=own.colour,
          fontweight='bold',
      )
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
        patches.Patch(color='#b5651d', label='door'),
    ]  # fmt: skip
    chart_style.add_legend(canvas, handles)
    return chart_style.to_svg(canvas)


def _draw_blocks(
    ax: Any,
    name: str,
    start: np.ndarray,
    end: np.ndarray,
    one: Map,
    style: chart_style.Style,
) -> None:
  starts = np.unique(start.round(3), axis=0)
  middle = starts.mean(axis=0)
  edge = 2 * one.half_size
  if len(starts) == 1:
    ax.add_patch(
        patches.Rectangle(
            middle - one.half_size, edge, edge, facecolor='none',
            edgecolor=chart_style.INK, linestyle=':', zorder=4,
        )
    )  # fmt: skip
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
      color=style.colour, mfc='white' if one.is_twin else style.colour,
      alpha=chart_style.PALE, markeredgewidth=0.6, zorder=3,
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

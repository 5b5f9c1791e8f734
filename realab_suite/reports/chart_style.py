"""Colours, markers and axes that all charts of a report share."""

from collections.abc import Sequence
import dataclasses
import io
import math
from typing import Any, final

import matplotlib
from matplotlib import figure
from matplotlib import ticker

# Of Okabe and Ito, who chose them for eyes of every kind; without the yellow,
# which is hard to see on white. Markers tell runs apart without colour.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_MARKERS = ('o', 's', '^', 'D', 'v', 'P', 'X')
GREY = '#767676'
INK = '#222222'
PALE = 0.55
_WIDTH = 11.4
# Letters of a name.
_ROOM = 24
_STYLE: Any = {
    'svg.fonttype': 'none',  # Text stays text: small, and it can be searched.
    'svg.hashsalt': 'realab_suite',
    'font.family': 'sans-serif',
    'font.size': 9,
    'axes.titlesize': 9,
    'axes.edgecolor': '#888888',
    'axes.labelcolor': INK,
    'text.color': INK,
    'text.parse_math': False,  # A name may have dollars in it.
    'xtick.color': '#555555',
    'ytick.color': '#555555',
    'axes.unicode_minus': True,
}


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


def style_context() -> Any:
  """Returns a context in which Matplotlib draws with this style."""
  return matplotlib.rc_context(_STYLE)


def new_figure(
    rows: int,
    columns: int,
    height: float,
    width: float = _WIDTH,
    **options: Any,
) -> tuple[figure.Figure, Any]:
  """Returns a figure and its array of axes, `(rows, columns)`.

  Args:
    rows: Number of rows.
    columns: Number of columns.
    height: Height of a row, in inches.
    width: Width of the figure, in inches.
    **options: Options of `Figure.subplots`.
  """
  canvas = figure.Figure(
      figsize=(width, rows * height + 0.6), layout='constrained'
  )
  return canvas, canvas.subplots(rows, columns, squeeze=False, **options)


def to_svg(canvas: figure.Figure) -> bytes:
  """Returns a figure as SVG; equal figures give equal bytes."""
  file = io.BytesIO()
  # Nothing about when, or by which version: that is no part of a figure.
  nothing = {key: None for key in ('Date', 'Creator', 'Format', 'Type')}
  canvas.savefig(
      file, format='svg', metadata=nothing, bbox_inches='tight', pad_inches=0.05
  )
  data = file.getvalue()
  # Without the document type, which is an address in the net.
  return data[data.index(b'<svg') :]


def add_legend(canvas: figure.Figure, handles: list[Any]) -> None:
  """Adds a legend below a figure, in as many columns as fit."""
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


def tidy_axes(ax: Any) -> None:
  """Adds a pale grid and removes the upper and right borders."""
  ax.grid(color='#e6e6e6', linewidth=0.6)
  ax.set_axisbelow(True)
  for side in ('top', 'right'):
    ax.spines[side].set_visible(False)


def set_symlog(axis: Any, set_scale: Any, threshold: float) -> None:
  """Makes an axis logarithmic, but linear near zero, with few plain ticks."""
  set_scale('symlog', linthresh=threshold, linscale=0.6)
  # Powers of ten within the linear part would be on top of each other.
  lowest = 10.0 ** math.ceil(math.log10(threshold))
  axis.set_major_locator(
      ticker.SymmetricalLogLocator(base=10, linthresh=lowest)
  )
  axis.set_minor_locator(ticker.NullLocator())
  axis.set_major_formatter(ticker.FuncFormatter(format_number))


def shorten(name: str) -> str:
  """Returns as much of a name as there is room for."""
  return name if len(name) <= _ROOM else f'{name[: _ROOM - 1]}…'


def format_number(value: float, position: int | None = None) -> str:
  """Formats a number for a tick of an axis."""
  del position
  return f'{value:,.5g}'.replace('-', '\N{MINUS SIGN}')

"""Colours, markers and axes of the SVG charts in a report.

Equal figures give equal bytes.
"""

from collections.abc import Sequence
import dataclasses
import io
import math
from typing import Any, final

import matplotlib
from matplotlib import figure
from matplotlib import ticker

# Palette of Okabe and Ito, for readers with and without colour blindness.
# Yellow is left out because it is hard to see on white. Markers distinguish
# runs without colour.
_COLOURS = (
    '#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#000000',
)  # fmt: skip
_MARKERS = ('o', 's', '^', 'D', 'v', 'P', 'X')
GREY = '#767676'
INK = '#222222'
PALE = 0.55
_WIDTH = 11.4
# Longest name that is drawn in full, in characters.
_LONGEST_NAME = 24
_STYLE: Any = {
    'svg.fonttype': 'none',  # Text stays small and searchable.
    'svg.hashsalt': 'realab_suite',
    'font.family': 'sans-serif',
    'font.size': 9,
    'axes.titlesize': 9,
    'axes.edgecolor': '#888888',
    'axes.labelcolor': INK,
    'text.color': INK,
    'text.parse_math': False,  # Names may contain dollar signs.
    'xtick.color': '#555555',
    'ytick.color': '#555555',
    'axes.unicode_minus': True,
}


@final
@dataclasses.dataclass(frozen=True)
class Style:
  """Colour and marker of a design, its twin and its baselines.

  Attributes:
    colour: Colour, in hexadecimal.
    marker: Marker of Matplotlib.
  """

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


def add_legend(canvas: figure.Figure, handles: list[Any]) -> None:
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


def tidy_axes(ax: Any) -> None:
  """Adds a pale grid and removes the upper and right borders."""
  ax.grid(color='#e6e6e6', linewidth=0.6)
  ax.set_axisbelow(True)
  for side in ('top', 'right'):
    ax.spines[side].set_visible(False)


def set_symlog(axis: Any, set_scale: Any, threshold: float) -> None:
  """Makes an axis logarithmic, and linear near zero, with few ticks."""
  set_scale('symlog', linthresh=threshold, linscale=0.6)
  # Powers of ten within the linear part would overlap.
  lowest = 10.0 ** math.ceil(math.log10(threshold))
  axis.set_major_locator(
      ticker.SymmetricalLogLocator(base=10, linthresh=lowest)
  )
  axis.set_minor_locator(ticker.NullLocator())
  axis.set_major_formatter(ticker.FuncFormatter(format_number))


def shorten(name: str) -> str:
  """Shortens a name to the width of a chart."""
  return name if len(name) <= _LONGEST_NAME else f'{name[: _LONGEST_NAME - 1]}…'


def format_number(value: float, position: int | None = None) -> str:
  """Formats a number for a tick of an axis."""
  del position
  return f'{value:,.5g}'.replace('-', '\N{MINUS SIGN}')

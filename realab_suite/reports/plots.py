"""Plots of single episodes: trajectories, and register values over time."""

from collections.abc import Iterable, Mapping, Sequence
import math
import os
import pathlib
from typing import IO, Any, Final

import matplotlib
from matplotlib import cm
from matplotlib import collections
from matplotlib import colors
from matplotlib import figure
from matplotlib import lines
from matplotlib import patches
from matplotlib import patheffects
import numpy as np

from realab_suite.entities import appearance
from realab_suite.experiments import tracking

TIDY_AXES: Final[Any] = {
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'grid.color': '#e6e6e6',
    'grid.linewidth': 0.6,
}
"""Settings of Matplotlib for axes with a pale grid and two borders."""

_DOTS_PER_INCH = 100
# Sizes in inches.
_WIDTH = 12.0
_PANELS = 11.1
_WIDEST_PANEL = 5.0
_TITLE = 0.3
_MOST_COLUMNS = 3
_INK = '0.15'
_FLOOR = '0.95'
_HALO = [patheffects.withStroke(linewidth=2.5, foreground='white')]
# Palette of Okabe and Ito, for readers with and without colour blindness.
_ORANGE = '#E69F00'
_SKY_BLUE = '#56B4E9'
_VERMILLION = '#D55E00'
_PURPLE = '#CC79A7'
# Blocks displaced by less than this count as not moved, in metres.
_UNMOVED = 0.05
# The pressed pad is a part of the post of the pad.
_HIDDEN = 'pressed_pad'


def draw(tracks: Mapping[str, tracking.Track], folder: pathlib.Path) -> None:
  """Draws the trajectories and the register values of some runs.

  Args:
    tracks: A track per run, all with the same world.
    folder: New folder for the PNG files.
  """
  folder.mkdir()
  draw_trajectories(tracks, folder / 'trajectories.png')
  if any(track.registers for track in tracks.values()):
    draw_time_line(tracks, folder / 'time_line.png')


def draw_trajectories(
    tracks: Mapping[str, tracking.Track],
    path: str | os.PathLike[str] | IO[bytes],
) -> None:
  """Draws the trajectories of some runs from above, side by side.

  Args:
    tracks: A track per run, all with the same world.
    path: PNG file to write, or a file that is open.
  """
  rows = math.ceil(len(tracks) / _MOST_COLUMNS)
  columns = math.ceil(len(tracks) / rows)
  first = next(iter(tracks.values()))
  low, high = extent(first.shapes)
  width = min(_PANELS / columns, _WIDEST_PANEL)
  height = width * (high[1] - low[1]) / (high[0] - low[0]) + _TITLE
  canvas = figure.Figure(
      figsize=(columns * width + 1.0, rows * height + 1.0),
      dpi=_DOTS_PER_INCH,
      layout='constrained',
  )
  axes = canvas.subplots(rows, columns, squeeze=False)
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
  add_legend(canvas, _world_legend(tracks.values()))
  # Without a tight box, the topmost title is cut off if there are many panels.
  canvas.savefig(path, bbox_inches='tight', pad_inches=0.1)


def draw_time_line(
    tracks: Mapping[str, tracking.Track], path: str | os.PathLike[str]
) -> None:
  """Draws clean contents, written values and readings of registers over time.

  Args:
    tracks: A track per run, all with the same registers, at least one.
    path: PNG file to write.
  """
  first = next(iter(tracks.values()))
  canvas = figure.Figure(
      figsize=(_WIDTH, 1.9 * len(tracks) + 1.0),
      dpi=_DOTS_PER_INCH,
      layout='constrained',
  )
  with matplotlib.rc_context(TIDY_AXES):
    axes = canvas.subplots(
        len(tracks), len(first.registers), squeeze=False, sharex=True
    )
  for row, (run, track) in zip(axes, tracks.items(), strict=True):
    # The only title in its row, so that a long name has room.
    row[0].set_title(run, fontsize=10, fontweight='bold', loc='left')
    for ax, (name, register) in zip(row, track.registers.items(), strict=True):
      _draw_values(ax, track.times, register)
      ax.text(
          0.01, 0.97, f'{name} ({register.role} register)', fontsize=9,
          va='top', transform=ax.transAxes, path_effects=_HALO, zorder=6,
      )  # fmt: skip
    row[0].set_ylabel('value (units)')
  for ax in axes[-1]:
    ax.set_xlabel('time (s)')
  add_legend(canvas, axes[0, 0].get_legend_handles_labels()[0])
  canvas.savefig(path)


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


def extent(
    shapes: Sequence[tracking.Shape],
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the lowest and the highest corner around shapes, with a margin."""
  corners = np.concatenate([shape.outline for shape in shapes])
  return corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1


def draw_shapes(ax: Any, shapes: Iterable[tracking.Shape]) -> None:
  """Draws shapes from above, in their order."""
  for shape in shapes:
    ax.add_patch(
        patches.Polygon(shape.outline, facecolor=shape.colour, linewidth=0)
    )


def draw_block(
    ax: Any, centre: np.ndarray, half_size: float, **options: Any
) -> None:
  """Draws a block from above.

  Args:
    ax: Axes in metres.
    centre: Position of its centre, `(2,)`.
    half_size: Half its edge length, in metres.
    **options: Options of the rectangle, such as `facecolor`.
  """
  x, y = centre - half_size
  edge = 2 * half_size
  options = {'facecolor': 'none', 'linewidth': 1.0, 'zorder': 4, **options}
  ax.add_patch(patches.Rectangle((x, y), edge, edge, **options))


def _draw_world(
    ax: Any, run: str, track: tracking.Track, clock: cm.ScalarMappable
) -> None:
  ax.set_facecolor(_FLOOR)
  draw_shapes(ax, (one for one in track.shapes if one.kind != _HIDDEN))
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
    draw_block(ax, before, register.half_size, edgecolor=_INK, linestyle=':')
    draw_block(
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


def _draw_values(
    ax: Any, times: np.ndarray, register: tracking.RegisterTrack
) -> None:
  applied, obstruction, permanent, reading = np.array(
      [
          register.applied, register.obstruction, register.permanent,
          register.reading,
      ]
  )  # fmt: skip
  ax.plot(times, register.clean, color='0.6', linewidth=4.0, label='clean')
  ax.plot(times, applied, color=_INK, linewidth=1.2, label='applied')
  ax.plot(
      times, reading, color=_VERMILLION, linewidth=1.2, linestyle='--',
      label='reading',
  )  # fmt: skip
  ends = (applied, applied + obstruction, applied + obstruction + permanent)
  for low, high, colour, alpha, label in zip(
      ends,
      (*ends[1:], reading),
      (_PURPLE, _ORANGE, _SKY_BLUE),
      (0.45, 0.45, 0.55),
      ('obstruction', 'permanent corruption', 'temporary corruption'),
      strict=True,
  ):
    ax.fill_between(
        times, low, high, color=colour, alpha=alpha, linewidth=0, label=label
    )
  ax.margins(x=0.01)
  ax.set_ylim(_limits([register.clean, register.applied, register.reading]))


def _limits(values: Any) -> tuple[float, float]:
  """Returns limits of an axis, with a minimum span."""
  low, high = np.nanmin(values), np.nanmax(values)
  middle, half = (low + high) / 2, max(0.6 * (high - low), 1.2)
  return middle - half, middle + half


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
  dotted = patches.Patch(facecolor='none', edgecolor=_INK, linestyle=':')
  dotted.set_label('block at the start')
  handles += [
      _marker('o', 'avatar at the start'),
      _marker('X', 'avatar at the end'),
      dotted,
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
  options = {'color': 'white', 'markeredgecolor': _INK, **options}
  return lines.Line2D(
      [], [], marker=marker, linestyle='', label=label, markersize=8, **options
  )

"""Layouts of rooms: places for registers, and where the avatar begins."""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np

from realab_suite.entities import arenas

FOOTPRINT = np.add(((-0.5, 2.3), (-0.35, 0.6)), (-0.15, 0.15))
"""Rectangle around a station in which a register with a range of up to 20 units
moves its blocks, with some clearance: `(from, to)` along x and y, in m. A world
keeps its own objects outside, whatever registers a design has."""

START_SPREAD = 0.4
"""Half-width of the square of start positions of the avatar, in m."""


def stations(*positions: tuple[float, float]) -> dict[str, tuple[float, float]]:
  """Returns places for registers, named `station_1`, `station_2` and so on.

  Args:
    *positions: Position of each, `(x, y)`, in m.
  """
  return {f'station_{i}': p for i, p in enumerate(positions, start=1)}


@final
@dataclasses.dataclass(frozen=True)
class Layout:
  """Places in a room; by default, those of the variation `standard`.

  Attributes:
    stations: Position of each named place for a register, `(x, y)`, in m.
    middle: Centre of the square of start positions of the avatar, `(x, y)`, in
      m.
    barrier: Ends of a barrier along x, each `(x, y)`, in m; `None` for no
      barrier.
  """

  stations: Mapping[str, tuple[float, float]] = dataclasses.field(
      default_factory=lambda: stations(
          (1.4, -2.2), (-2.9, -3.3), (1.4, -3.3), (-2.9, -2.2)
      )
  )
  middle: tuple[float, float] = (0.0, -0.8)
  barrier: tuple[tuple[float, float], tuple[float, float]] | None = None

  @property
  def start(self) -> arenas.Rectangle:
    """Square of start positions of the avatar's centre."""
    x, y = self.middle
    s = START_SPREAD
    return arenas.Rectangle((x - s, y - s), (x + s, y + s))

  def are_before_the_barrier(self, points: np.ndarray) -> np.ndarray:
    """Returns whether points are on the side of the barrier with the start.

    Args:
      points: Positions, `(..., 2)`, in m.

    Returns:
      `(...)` bool; True without a barrier.
    """
    if self.barrier is None:
      return np.ones(np.shape(points)[:-1], bool)
    y = self.barrier[0][1]
    return (np.asarray(points)[..., 1] < y) == (self.middle[1] < y)

"""Footprints: where writes can put the blocks of a register."""

from collections.abc import Sequence
import itertools
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.entities import block_kinds
from realab_suite.entities import protocols

# Number of values that are tried with a kind that declares no footprint.
NUM_VALUES = 257
# Largest difference of the steps of a block that moves evenly, in m or rad.
# Over all values, it adds up to less than 10 micrometres.
_ROUNDING = 1e-9


@final
class Path(NamedTuple):
  """A line along which values move a block, in the frame of its register.

  Attributes:
    block: Index of the block in `Register.blocks`.
    first: Centre of the block at one end, `(3,)`, in m.
    last: Centre at the other end, `(3,)`, in m.
    values: Values at the two ends.
    headings: Angles about the vertical at the two ends, in rad.
    is_sight: True for a line of sight, along which the block is looked at.
  """

  block: int
  first: np.ndarray
  last: np.ndarray
  values: tuple[float, float]
  headings: tuple[float, float] = (0.0, 0.0)
  is_sight: bool = False


def sampled(
    physics: protocols.Physics,
    blocks: Sequence[block_kinds.Block],
    value_range: tuple[float, float],
    pose: Any,
) -> list[Path]:
  """Returns the lines between the poses of blocks at many values.

  A motion to and fro between two neighbouring values, or a jump, can be missed.

  Args:
    physics: One world; its state is changed.
    blocks: Blocks of a register.
    value_range: Lowest and highest value.
    pose: Function that moves the blocks to the poses of a value.
  """
  values = np.linspace(*value_range, NUM_VALUES)
  centres = np.empty((len(blocks), NUM_VALUES, 3))
  headings = np.empty((len(blocks), NUM_VALUES))
  for i, value in enumerate(values):
    pose(np.clip(value, *value_range))
    for j, block in enumerate(blocks):
      centres[j, i] = block.position(physics)
      headings[j, i] = block.heading(physics)
  tracks = np.dstack([centres, np.unwrap(headings)])
  paths = []
  for j, track in enumerate(tracks):
    ends = _ends(track)
    paths += [
        Path(
            j,
            track[first, :3],
            track[last, :3],
            (float(values[first]), float(values[last])),
            (float(track[first, 3]), float(track[last, 3])),
        )
        for first, last in itertools.pairwise(ends)
    ]
  return paths


def _ends(track: np.ndarray) -> np.ndarray:
  """Returns the ends of the lines that the poses of a block are on.

  Along a line, equal steps of the value move the block equally far, or turn it
  equally far on the spot. A block that moves and turns at once has a line for
  each step, because a longer one would contain poses that it does not have.

  Args:
    track: Positions and headings of the block, `(values, 4)`.

  Returns:
    Numbers of the values at the ends, in order, `(lines + 1,)`.
  """
  steps = np.diff(track, axis=0)
  is_change = np.abs(steps) > _ROUNDING
  is_curved = is_change[:, :3].any(axis=1) & is_change[:, 3]
  is_end = (np.abs(np.diff(steps, axis=0)) > _ROUNDING).any(axis=1)
  is_end |= is_curved[:-1] | is_curved[1:]
  return np.array([0, *np.flatnonzero(is_end) + 1, len(track) - 1])

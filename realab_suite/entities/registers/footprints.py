"""Footprints: where writes can put the blocks of a register."""

from collections.abc import Sequence
import itertools
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.entities import block_kinds
from realab_suite.entities import protocols

# Number of values that are tried with a kind that declares no footprint.
NUM_VALUES = 257


@final
class Path(NamedTuple):
  """A line along which values move a block, in the frame of its register.

  Attributes:
    block: Index of the block in `Register.blocks`.
    first: Centre of the block at one end, `(3,)`, in m.
    last: Centre at the other end, `(3,)`, in m.
    values: Values at the two ends.
    headings: Angles about the vertical at the two ends, in rad.
  """

  block: int
  first: np.ndarray
  last: np.ndarray
  values: tuple[float, float]
  headings: tuple[float, float] = (0.0, 0.0)


def sampled(
    physics: protocols.Physics,
    blocks: Sequence[block_kinds.Block],
    value_range: tuple[float, float],
    pose: Any,
) -> list[Path]:
  """Returns the lines between the poses of blocks at many values.

  A motion that is faster, such as a jump between two neighbouring values, can
  be missed.

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
  headings = np.unwrap(headings)
  return [
      Path(
          j,
          centres[j, i],
          centres[j, i + 1],
          (float(values[i]), float(values[i + 1])),
          (float(headings[j, i]), float(headings[j, i + 1])),
      )
      for j, i in itertools.product(range(len(blocks)), range(NUM_VALUES - 1))
  ]

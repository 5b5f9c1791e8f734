"""Footprints: where writes can put the blocks of a register."""

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.entities import block_kinds
from realab_suite.entities import protocols

# Number of values that are tried with a kind that declares no footprint.
NUM_VALUES = 257
# Displacement that counts as none, in m.
_NOISE = 1e-9


@final
class Path(NamedTuple):
  """A line along which values move a block, in the frame of its register.

  Attributes:
    block: Index of the block in `Register.blocks`.
    first: Centre of the block at one end, `(3,)`, in m.
    last: Centre at the other end, `(3,)`, in m.
    values: Values at the two ends.
    headings: Angles about the vertical at the two ends, in rad.
    slack: Distance from the line within which the block stays, in m.
  """

  block: int
  first: np.ndarray
  last: np.ndarray
  values: tuple[float, float]
  headings: tuple[float, float] = (0.0, 0.0)
  slack: float = 0.0


def sampled(
    physics: protocols.Physics,
    blocks: Sequence[block_kinds.Block],
    value_range: tuple[float, float],
    pose: Any,
) -> list[Path]:
  """Returns the paths of blocks, measured at many values.

  Between two neighbouring values, a curve deviates from a straight line by at
  most an eighth of its second difference there, and a corner by at most half of
  it; the whole of it is the slack. A motion that is faster, such as a jump
  between two neighbouring values, can be missed.

  Args:
    physics: One world; its state is changed.
    blocks: Blocks of a register.
    value_range: Lowest and highest value.
    pose: Function that moves the blocks to the poses of a value.
  """
  values = np.linspace(*value_range, NUM_VALUES)
  poses = np.empty((NUM_VALUES, len(blocks), 4))
  for i, value in enumerate(values):
    pose(np.clip(value, *value_range))
    for j, block in enumerate(blocks):
      poses[i, j, :3] = block.position(physics)
      poses[i, j, 3] = block.heading(physics)
  poses[..., 3] = np.unwrap(poses[..., 3], axis=0)
  return [
      path
      for j, block in enumerate(blocks)
      for path in _paths(j, values, poses[:, j], np.sqrt(2) * block.half_size)
  ]


def _paths(
    block: int, values: np.ndarray, poses: np.ndarray, radius: float
) -> list[Path]:
  """Returns the paths through the poses of a block.

  Args:
    block: Index of the block.
    values: Values at which it was measured, `(values,)`.
    poses: Its centre and heading at each of them, `(values, 4)`.
    radius: Horizontal distance of its corners from its centre, in m.
  """
  bends = np.abs(np.diff(poses, 2, axis=0))
  slack = np.zeros(len(poses))
  slack[1:-1] = np.linalg.norm(bends[:, :3], axis=1) + radius * bends[:, 3]
  moving = np.flatnonzero(np.ptp(poses, axis=0) > _NOISE).tolist()
  if len(moving) <= 1 and moving != [3]:  # Along an axis, or not at all.
    along = poses[:, moving[0] if moving else 0]
    ends = [(int(along.argmin()), int(along.argmax()))]
    widest = np.full(1, slack.max())
  else:
    ends = [(i, i + 1) for i in range(len(poses) - 1)]
    widest = np.maximum(slack[:-1], slack[1:])
  return [
      Path(
          block,
          poses[i, :3],
          poses[j, :3],
          (float(values[i]), float(values[j])),
          (float(poses[i, 3]), float(poses[j, 3])),
          float(distance),
      )
      for (i, j), distance in zip(ends, widest, strict=True)
  ]

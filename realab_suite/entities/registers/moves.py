"""Moves of the blocks of registers."""

import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols


def slide(
    physics: protocols.Physics,
    block: block_kinds.Block,
    start: np.ndarray,
    value: np.ndarray,
    scale: float,
    where: axes.Mask,
) -> np.ndarray:
  """Sets the coordinate of a block along the axis of its register.

  Args:
    physics: One world or a batch of worlds.
    block: The block.
    start: Coordinate that represents 0, `(...)`, in m.
    value: Value to represent, `(...)`.
    scale: Length per unit of value, in m.
    where: Worlds in which to move it, `(...)` bool; `None` for all worlds.

  Returns:
    Value that the block got, `(...)`: exactly `value` wherever nothing
    immovable is in the way.
  """
  along = start + value * scale
  placed = block.slide(physics, along, where)
  if placed is along:
    return value
  return np.where(placed == along, value, (placed - start) / scale)[()]


def undisturbed(
    start: np.ndarray, along: np.ndarray, height: float
) -> np.ndarray:
  """Returns the undisturbed position of a block, `(..., 3)`, in m.

  Args:
    start: Position that represents 0, `(..., 3)`, in m.
    along: Displacement along the axis, `(...)`, in m.
    height: Height of the centre of a block at rest, in m.
  """
  position = np.array(start)
  position[..., 0] += along
  position[..., 2] = height
  return position

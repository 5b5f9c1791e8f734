"""A register that stores its value in the heading of a block (section 3.1)."""

from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base

# Largest heading that represents a value, in rad. Headings are equal modulo a
# full turn. The range ends before half a turn, so that a small push at either
# end cannot change the sign of a reading.
_LARGEST_ANGLE = 3.0


@final
class BlockOrientationRegister(base.Register):
  """Register that stores a float as the heading of a block.

  The scale is in rad per unit. Turning or toppling the block is a temporary
  corruption, and the block turns with a hand that holds it. Carrying the block
  away without turning it is no corruption.
  """

  def _build_blocks(self) -> list[block_kinds.Block]:
    widest = max(abs(self._low), abs(self._high)) * self._scale
    if widest > _LARGEST_ANGLE:
      raise errors.SpecError(
          f'register {self.name!r}: range [{self._low}, {self._high}] at scale'
          f' {self._scale} turns the block by up to {widest:.3g} rad; must'
          f' be at most {_LARGEST_ANGLE} rad'
      )
    self._block = self._add_block(
        'block', appearance.OFFSET_BLOCK, (0.0, 0.0), turns_along=True
    )
    return [self._block]

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    del value  # It turns the block.
    position = np.array(self._origin(physics))
    position[..., 2] = self._block.rest_height
    return [position]

  def _put(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    [position] = self._places(physics, value)
    self._block.put(physics, position, value * self._scale, where)

  def _shift(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    self._block.turn(physics, value * self._scale, where)
    return value

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    return self._block.heading(physics) / self._scale

  def displacements(self, physics: protocols.Physics) -> np.ndarray:
    turned = self._block.heading(physics) - self.applied(physics) * self._scale
    moved = super().displacements(physics)
    # A turned block moves its sides.
    sides = np.abs(turned) * self._block.half_size
    return np.maximum(moved, sides[..., np.newaxis])

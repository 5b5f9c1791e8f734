"""A register that stores its value in the position of a block (section 3.1)."""

from typing import final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base
from realab_suite.entities.registers import moves


@final
class BlockPositionRegister(base.Register):
  """Register that stores a float as the displacement of a block from its start.

  Readings and writes are relative to the same start position, which nothing can
  change. Every corruption is therefore temporary: the next `write` moves the
  block back.
  """

  def _build_blocks(self) -> list[block_kinds.Block]:
    self._block = self._add_block(
        'block', appearance.OFFSET_BLOCK, (0.0, 0.0), (1.0, 0.0)
    )
    return [self._block]

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    start = self._origin(physics)
    along = value * self._scale
    return [moves.undisturbed(start, along, self._block.rest_height)]

  def _shift(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    start = self._origin(physics).T[0]
    return moves.slide(physics, self._block, start, value, self._scale, where)

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    started = self._origin(physics).T[0]
    return (self._block.along(physics) - started) / self._scale

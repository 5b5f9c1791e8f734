"""A register without blocks, for what an agent should not reach directly."""

from typing import final

import numpy as np

from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base


@final
class StoredRegister(base.Register):
  """Register that stores a number in a slot of the state, out of reach.

  It takes no place in the world, and nothing but a write changes it. What is
  written to it can still be corrupted: the register of a meter stores what was
  *measured*, also while the measurement is obstructed. With the channel
  `secure`, the register stores the ideal measurement.
  """

  HAS_BLOCKS = False

  def _build_blocks(self) -> list[block_kinds.Block]:
    return []

  def settle(self, physics: protocols.Physics) -> None:
    """Does nothing, because no block marks an origin."""

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    del physics, value
    return []

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    return self.applied(physics)

  def displacements(self, physics: protocols.Physics) -> np.ndarray:
    return np.zeros((*self.applied(physics).shape, 0))

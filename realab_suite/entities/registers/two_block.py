"""The two-block register, the paper's primary one (section 3.1, example)."""

from typing import final

import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base

# The offset block stands beside the line of the base block, so that both are
# seen when the value is zero.
_LATERAL = 0.05


@final
class TwoBlockRegister(base.Register):
  """Stores a float as the distance of two blocks along the register's axis.

  The two blocks are ordinary rigid bodies, so whatever pushes, lifts or carries
  them changes the stored value. They fail in different ways:

  * Moving the offset block is a temporary corruption. The next `write` puts the
    block back.
  * Moving the base block is a permanent corruption. `read` measures from where
    the base block is now, but `write` places the offset block relative to where
    the base block started, so every later reading is off by the same amount.
    Moving the base block back ends it.

  The two blocks never collide with each other; writing 0 would otherwise be a
  corruption.
  """

  def _build_blocks(self) -> list[block_kinds.Block]:
    lateral = self._block_size + _LATERAL
    self._base = self._add_block('base', 'base_block', (0.0, 0.0))
    self._offset = self._add_block('offset', 'offset_block', (0.0, lateral))
    self._from_origin = np.array([0.0, lateral, 0.0])
    if self._channel != 'welded':
      self._mjcf_root.contact.add('exclude', body1='base', body2='offset')
    return [self._base, self._offset]

  def _put(self, physics: protocols.Physics, value: np.ndarray) -> None:
    position = self._origin(physics) + self._from_origin
    position[..., 0] = axes.component(position, 0) + value * self._scale
    position[..., 2] = self._offset.rest_height
    self._offset.put(physics, position)

  def _look(self, physics: protocols.Physics) -> np.ndarray:
    distance = self._offset.along(physics) - self._base.along(physics)
    return distance / self._scale

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    started = axes.component(self._origin(physics), 0)
    return (started - self._base.along(physics)) / self._scale

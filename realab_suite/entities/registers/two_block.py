"""The two-block register, the main register of the paper (section 3.1)."""

from typing import final

from dm_control import composer
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base
from realab_suite.entities.registers import moves

# Gap between the paths of the two blocks, in m, so that both blocks are visible
# at a value of 0.
_LATERAL = 0.05


@final
class TwoBlockRegister(base.Register):
  """Register that stores a float as the distance of two blocks along its axis.

  The blocks are ordinary rigid bodies, so pushing, lifting or carrying them
  changes the stored value. The two kinds of corruption are:

  * Temporary: the offset block has moved. The next `write` moves it back.
  * Permanent: the base block has moved. `read` measures from the current
    position of the base block, but `write` moves the offset block relative to
    the start position of the base block. Every later reading is therefore wrong
    by the same amount, until the base block is moved back.

  The two blocks never collide with each other. Otherwise writing 0 would
  corrupt the value.
  """

  def _build_blocks(self) -> list[block_kinds.Block]:
    lateral = self._block_size + _LATERAL
    self._base = self._add_block(
        'base', appearance.BASE_BLOCK, (0.0, 0.0), (-1.0, 0.0)
    )
    self._offset = self._add_block(
        'offset', appearance.OFFSET_BLOCK, (0.0, lateral), (1.0, 0.0)
    )
    self._from_origin = np.array([0.0, lateral, 0.0])
    self._exclusion = self._mjcf_root.contact.add(
        'exclude', body1='base', body2='offset'
    )
    return [self._base, self._offset]

  def _use_block(self, root: composer.Entity, block: block_kinds.Block) -> None:
    self._exclusion.remove()
    self._mjcf_root.find('body', 'base').remove()
    self._base = self._blocks[0] = block
    lateral = block.half_size + self._block_size / 2 + _LATERAL
    self._from_origin = np.array([0.0, lateral, 0.0])
    self._exclusion = root.mjcf_model.contact.add(
        'exclude', body1=block.body, body2=self._offset.body
    )

  def detach_from_root(self) -> None:
    if self._borrowed is not None:
      self._exclusion.remove()
    super().detach_from_root()

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    base_position = self._origin(physics)
    offset_position = moves.undisturbed(
        base_position + self._from_origin,
        value * self._scale,
        self._offset.rest_height,
    )
    return [base_position, offset_position]

  def _put(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    _, position = self._places(physics, value)
    self._offset.put(physics, position, where=where)

  def _shift(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    start = self._origin(physics).T[0]
    return moves.slide(physics, self._offset, start, value, self._scale, where)

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    distance = self._offset.along(physics) - self._base.along(physics)
    return distance / self._scale

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    started = self._origin(physics).T[0]
    return (started - self._base.along(physics)) / self._scale

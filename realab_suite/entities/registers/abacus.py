"""The abacus: several numbers as the distances of beads from one block."""

import abc
from collections.abc import Sequence
from typing import final

import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base
from realab_suite.entities.registers import moves

# Distance between neighbouring rods in m, beside the size of a block.
_GAP = 0.05


class Abacus(base.Register):
  """Base class of registers that store a number in the place of each bead.

  Beads are blocks on rods along the axis, on both sides of a base block. The
  number of a bead is its distance from the base block along the axis, as in a
  two-block register, so the corruption is of two kinds:

  * Temporary: a bead has moved. It concerns the port of this bead alone.
  * Permanent: the base block has moved, which adds the same number to all
    ports.

  A subclass names its beads in `PORTS`, and says where their rods are.
  """

  @property
  @abc.abstractmethod
  def rods(self) -> Sequence[int]:
    """Place of each rod beside the base block, in widths; not 0."""

  def _build_blocks(self) -> list[block_kinds.Block]:
    frame = self._add_block(
        'base', appearance.BASE_BLOCK, (0.0, 0.0), (-1.0, 0.0)
    )
    width = self._block_size + _GAP
    self._rods = [np.array([0.0, rod * width, 0.0]) for rod in self.rods]
    self._beads = [
        self._add_block(
            port,
            appearance.OFFSET_BLOCK,
            rod[:2].tolist(),
            (1.0, 0.0),
            [port],
        )
        for port, rod in zip(self.PORTS, self._rods, strict=True)
    ]
    return [frame, *self._beads]

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    origin = self._origin(physics)
    beads = [
        moves.undisturbed(
            origin + rod, value[..., i] * self._scale, bead.rest_height
        )
        for i, (rod, bead) in enumerate(
            zip(self._rods, self._beads, strict=True)
        )
    ]
    return [origin, *beads]

  def _put(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    _, *places = self._places(physics, value)
    for bead, place in zip(self._beads, places, strict=True):
      bead.put(physics, place, where=where)

  def _shift(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    start = self._origin(physics).T[0]
    placed = [
        moves.slide(physics, bead, start, value[..., i], self._scale, where)
        for i, bead in enumerate(self._beads)
    ]
    return np.stack(placed, axis=-1)

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    frame = self._blocks[0].along(physics)
    beads = [bead.along(physics) - frame for bead in self._beads]
    return np.stack(beads, axis=-1) / self._scale

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    started = self._origin(physics).T[0]
    moved = (started - self._blocks[0].along(physics)) / self._scale
    return np.stack([moved] * len(self.PORTS), axis=-1)


@final
class Abacus2(Abacus):
  """Abacus with two beads."""

  PORTS = 'a', 'b'
  rods = 1, -1


@final
class Abacus4(Abacus):
  """Abacus with four beads."""

  PORTS = 'a', 'b', 'c', 'd'
  rods = 1, -1, 2, -2

"""Crates: cubes of a world, which registers may use as their base blocks."""

from collections.abc import Sequence
from typing import final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import measurables
from realab_suite.entities import protocols

# Largest edge length of a block, in m.
_LARGEST = 1.0


@final
class Crate(measurables.MeasurableEntity):
  """A cube that an avatar can push, carry and throw, as it can blocks.

  A world attaches it, and may offer its `place` to registers. A two-block
  register there has no base block of its own: the crate is its base block, so
  that moving the crate is permanent corruption.
  """

  def _build(
      self,
      name: str = 'crate',
      size: float = 0.3,
      mass: float = 1.0,
      kind: str = appearance.CRATE,
  ) -> None:
    """Builds the crate.

    Args:
      name: Name of the model.
      size: Edge length, in m.
      mass: Mass, in kg.
      kind: Class that rays report, with a colour.

    Raises:
      SpecError: If the size or the mass is outside the limits of blocks.
    """
    for field, value, least, most in (
        ('size', size, block_kinds.LEAST_SIZE, _LARGEST),
        ('mass', mass, 0.01, 100.0),
    ):
      if not isinstance(value, int | float) or not least <= value <= most:
        raise errors.SpecError(
            f'crate {name!r}: {field} {value!r:.40}; must be from {least:g} to'
            f' {most:g}'
        )
    self._mjcf_root = mjcf.RootElement(model=name)
    style = appearance.geom_style(kind)
    self._block = block_kinds.FreeBlock(
        self._mjcf_root,
        'block',
        (0.0, 0.0),
        size / 2,
        mass,
        style,
        direction=(-1.0, 0.0),  # That of a base block.
    )
    self._place = arenas.Place((0.0, 0.0))

  @property
  def block(self) -> block_kinds.Block:
    """Cube of the crate."""
    return self._block

  @property
  def place(self) -> arenas.Place:
    """Place for a register whose base block is the crate."""
    return self._place

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable((self._block.body,))

  def attach_to(
      self,
      root: composer.Entity,
      position: Sequence[float],
      spread: Sequence[float] = (0.0, 0.0),
  ) -> None:
    """Attaches the crate to the root entity of a task.

    Args:
      root: Root entity of the task.
      position: Centre of the region of start positions, `(x, y)`, in m.
      spread: Half-widths of that region, `(x, y)`, in m.
    """
    x, y = (float(number) for number in position)
    along, across = (float(number) for number in spread)
    root.attach(self).pos = (x, y, 0.0)
    self._block.surroundings.limit(-along, along)
    self._place = arenas.Place(
        (x, y), spread=(along, across), block=self._block
    )

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Draws the start position."""
    spread = np.array(self._place.spread)
    self._put(physics, random_state.uniform(-spread, spread))

  def put(self, physics: protocols.Physics, position: np.ndarray) -> None:
    """Puts the crate at a place in one world, at rest.

    Args:
      physics: Physics of one world.
      position: Its middle, `(x, y)`, in m.
    """
    self._put(physics, position - np.array(self._place.position))

  def _put(self, physics: protocols.Physics, offset: np.ndarray) -> None:
    self._block.put(physics, np.array([*offset, self._block.rest_height]))

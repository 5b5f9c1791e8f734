"""Kinds of registers: their blocks, and the values that their poses store."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from dm_control import composer
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import arguments as register_arguments


class Kind(modelled.ModelledEntity):
  """Base class for `Register`, with the methods that its subclasses override.

  A subclass builds its blocks in `_build_blocks`, says where they are for a
  value in `_places`, and computes the represented value in `_read_blocks`. If
  values turn blocks, or leave some of them alone, it overrides `_put`; if a
  write changes less than the poses of the blocks, `_shift`. If a write does not
  restore the coordinates that carry the value of all blocks, it returns the
  resulting permanent corruption in `_permanent`.

  A register stores one number, of the shape `(...)`, unless its class names
  several *ports*:

      class Pair(registers.Register):
        PORTS = 'upper', 'lower'

  Its values and readings then have the shape `(..., ports)`, wherever this
  class says `(...)`, and one write sets all of them. Everything outside the
  register sees each port as a scalar register, `<register>_<port>`; see
  `ports`. Masks of worlds keep the shape `(...)`.

  Attributes:
    PORTS: Names of the ports; none for a register that stores one number, which
      is its own port.
    HAS_BLOCKS: False for a kind that no physics can change.
  """

  PORTS: ClassVar[tuple[str, ...]] = ()
  HAS_BLOCKS: ClassVar[bool] = True

  _name: str
  _role: register_arguments.Role
  _dof: register_arguments.Dof
  _block_size: float
  _mass: float
  _blocks: list[block_kinds.Block]
  _borrowed: block_kinds.Block | None
  _slots: state.Slots

  @abc.abstractmethod
  def _build_blocks(self) -> list[block_kinds.Block]:
    """Adds the blocks with `_add_block` and returns them.

    The position of the first block is the position of the register.
    """

  @abc.abstractmethod
  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    """Returns the undisturbed position of each block, `(..., 3)`, in m.

    Positions are in the register's frame. `_origin` is that of the first block
    at the start of the episode.

    Args:
      physics: One world or a batch of worlds.
      value: Value in the register's units, `(...)`.
    """

  def _put(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    """Moves the blocks to the undisturbed poses of a value, `(...)`.

    Episodes begin with these poses.

    Args:
      physics: One world or a batch of worlds.
      value: Value in the register's units, `(...)`.
      where: Worlds in which to move them, `(...)` bool; `None` for all worlds.
    """
    places = self._places(physics, value)
    for block, place in zip(self._blocks, places, strict=True):
      block.put(physics, place, where=where)

  def _shift(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    """Changes only the coordinates that carry the value, as a write does.

    Without this method, each write restores the poses of the blocks.

    Args:
      physics: One world or a batch of worlds.
      value: Value in the register's units, `(...)`.
      where: As in `_put`.

    Returns:
      Value that the blocks got, `(...)`: `value`, unless something immovable is
      in the way.
    """
    self._put(physics, value, where)
    return value

  @abc.abstractmethod
  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value that the blocks represent, `(...)`."""

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the permanent corruption, `(...)`, in the register's units.

    It is the own corruption that readings have immediately after a write that
    nothing obstructs.
    """
    return np.zeros_like(self._slots.of(physics).applied)

  def nearest(self, value: Any) -> Any:
    """Returns the values that a write of values applies, `(...)`.

    Kinds that cannot store every number of their range override this method, so
    that rounding counts as saturation.

    Args:
      value: Values in the range, `(...)`; or nan, which stays.
    """
    return value

  @property
  def changes_unmoved(self) -> bool:
    """True if its reading can change without a motion of its blocks.

    Kinds that override `read_without` are so. Others override this property:
    for example, if they read how far away the avatar is.
    """
    return type(self).read_without is not Kind.read_without

  def read_without(
      self,
      physics: protocols.Physics,
      is_gone: Callable[[np.ndarray], np.ndarray],
  ) -> np.ndarray | None:
    """Returns the reading if some of what is in the way were not there.

    Args:
      physics: One world or a batch of worlds.
      is_gone: Function of the geoms that hide something, `(..., lines)`; -1 for
        none. It returns True for those that are not there.

    Returns:
      The reading, `(...)`; `None` for kinds that nothing can hide, such as
      those that read the poses of their blocks.
    """
    del physics, is_gone
    return None

  def displacements(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the distance by which each block has moved, `(..., blocks)`.

    It is the distance in m from the position that the reset and the last write
    gave the block, in any direction, and is computed from the blocks even if
    the register is secure.

    Args:
      physics: One world or a batch of worlds.
    """
    places = self._places(physics, self._slots.of(physics).applied[()])
    moved = [
        np.linalg.norm(block.position(physics) - place, axis=-1)
        for block, place in zip(self._blocks, places, strict=True)
    ]
    return np.stack(moved, axis=-1)

  def _use_block(self, root: composer.Entity, block: block_kinds.Block) -> None:
    """Replaces the base block by a block of the world, in `blocks` as well.

    Kinds with a base block may override this method. The register is attached.

    Args:
      root: Root entity of the task.
      block: Block of the world.
    """
    raise NotImplementedError  # See `check_can_use_a_block`.

  def check_can_use_a_block(self) -> None:
    """Checks that the register can use a block of the world.

    Raises:
      SpecError: If its kind does not override `_use_block`, or it uses a block
        of the world already.
    """
    if type(self)._use_block is Kind._use_block:
      problem = f'{type(self).__name__} has no base block'
    elif self._borrowed is not None:
      problem = 'it uses another block already'
    else:
      return
    raise errors.SpecError(
        f'register {self._name!r}: cannot use a block of the world: {problem};'
        ' must be of a kind with a base block, such as two_block, or have'
        ' another place'
    )

  def _origin(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the start position of the first block, `(..., 3)`, in m."""
    origin: np.ndarray = self._slots.of(physics).origin
    return origin

  def _add_block(
      self,
      name: str,
      class_name: str,
      position: Sequence[float],
      direction: tuple[float, float] | None = None,
      ports: Sequence[str] = (),
      turns_along: bool = False,
  ) -> block_kinds.Block:
    """Adds a block with the register's degrees of freedom.

    Args:
      name: Name of the block within the register.
      class_name: Class that the ray sense reports: `appearance.BASE_BLOCK` or
        `appearance.OFFSET_BLOCK`.
      position: Position at rest in the register's frame, `(x, y)`, in m.
      direction: Direction of the motion that raises the reading, if there is
        one; see `block_kinds.Block.direction`.
      ports: Ports that depend on the block; all, if none are named. Attribution
        charges permanent corruption of a port to the last mover of its first
        block, and temporary corruption to that of its last one.
      turns_along: True if the block turns with a hand that holds it, as one
        whose heading carries a value has to.
    """
    is_free = self._dof == 'free'
    kind = block_kinds.FreeBlock if is_free else block_kinds.PlanarBlock
    is_offset = class_name == appearance.OFFSET_BLOCK
    colour = appearance.ROLE_COLOURS[self._role][int(is_offset)]
    return kind(
        self._mjcf_root,
        name,
        position,
        self._block_size / 2,
        self._mass,
        appearance.geom_style(class_name, colour),
        direction,
        ports,
        turns_along,
    )

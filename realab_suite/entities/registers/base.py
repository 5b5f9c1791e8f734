"""What every register does: write, read, and tell what became of a value.

A register is any physical object that stores a value in a physical property
(paper, section 3.1). Whatever moves the object changes the value, so there is
no corruption function anywhere in this package.
"""

import abc
from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import records

# embedded: the value is in the blocks, and the blocks are in the world.
# welded: the value is in the blocks, which nothing but a write can move.
# secure: the value is in the state; the blocks are scenery that can be moved.
CHANNELS = ('embedded', 'welded', 'secure')
DOFS = ('free', 'planar')
OVERFLOWS = ('saturate', 'error')


@final
class RegisterObservables(composer.Observables):
  """The reading, off by default: who may see it is not the register's say."""

  @composer.observable
  def reading(self) -> observable.Generic:
    return observable.Generic(self._entity.read)


class Register(composer.Entity):
  """Stores a number in the pose of blocks.

  A register is one subtree that can be attached to any entity at the root of a
  task: `register.attach_to(arena, (x, y))`. It works in a plain Composer
  environment as well as in this package's.

  A subclass builds its blocks in `_build_blocks`, and says how a value is put
  into them (`_put`) and read off them (`_look`). If there is something that a
  write does not put right, `_permanent` says by how much that falsifies a
  reading.
  """

  def _build(
      self,
      name: str,
      *,
      value_range: Sequence[float],
      scale: float = 0.1,
      initial: float = 0.0,
      role: str = 'feedback',
      channel: str = 'embedded',
      dof: str = 'free',
      on_overflow: str = 'saturate',
      block_size: float = 0.2,
      mass: float = 1.0,
  ) -> None:
    """Builds the register.

    Args:
      name: Name of the register, and of its model until it is attached to a
        model that has another one of that name.
      value_range: The lowest and the highest value that can be stored.
      scale: Metres (radians for an orientation) per unit of the value.
      initial: The value at the start of an episode.
      role: What the register is for, a key of `appearance.ROLE_COLOURS`.
      channel: One of `CHANNELS`.
      dof: One of `DOFS`: what an embedded block can do when it is pushed.
      on_overflow: Whether a value out of range is saturated or is an error.
      block_size: The length of an edge of a block, metres.
      mass: Of each block, kilograms.
    """
    _check(name, value_range, scale, initial, role, channel, dof, on_overflow)
    # Not the name of the model: attaching renames that where it is taken.
    self._name = name
    self._low, self._high = (float(bound) for bound in value_range)
    self._scale = scale
    self._initial = initial
    self._role = role
    self._channel = channel
    self._dof = dof
    self._on_overflow = on_overflow
    self._block_size = block_size
    self._mass = mass
    self._spread = np.zeros(2)
    self._mjcf_root = mjcf.RootElement(model=name)
    self._applied_slot = state.Slot(self._mjcf_root, 'applied')
    self._stored_slot = state.Slot(self._mjcf_root, 'stored')
    self._origin_slot = state.Slot(self._mjcf_root, 'origin', 3)
    self._blocks = self._build_blocks()

  def _build_observables(self) -> RegisterObservables:
    return RegisterObservables(self)

  @abc.abstractmethod
  def _build_blocks(self) -> list[block_kinds.Block]:
    """Adds the blocks with `_add_block`; the first is where the register is."""

  @abc.abstractmethod
  def _put(self, physics: protocols.Physics, value: np.ndarray) -> None:
    """Moves blocks so that they represent `value`, shape `(...)`."""

  @abc.abstractmethod
  def _look(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value that the blocks represent, shape `(...)`."""

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    """Returns by how much the next reading after a write will be off."""
    return np.zeros_like(self._applied_slot.get(physics))

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def name(self) -> str:
    return self._name

  @property
  def role(self) -> str:
    """What the register is for: feedback, meter, query or signal."""
    return self._role

  @property
  def channel(self) -> str:
    """Whether the value is `embedded`, `welded` or `secure`."""
    return self._channel

  @property
  def scale(self) -> float:
    """Metres (radians for an orientation) per unit of the value."""
    return self._scale

  @property
  def value_range(self) -> tuple[float, float]:
    """Lowest and highest value that can be stored."""
    return self._low, self._high

  @property
  def blocks(self) -> list[block_kinds.Block]:
    """The blocks; the first one is where the register stands."""
    return self._blocks

  @property
  def spread(self) -> np.ndarray:
    """Half-widths of the region that the register stands in, `(2,)`, metres."""
    return self._spread

  @property
  def value_spec(self) -> specs.BoundedArray:
    """Shape `()`, float64, and the range that can be stored."""
    return specs.BoundedArray(
        (), np.float64, self._low, self._high, name=self.name
    )

  def attach_to(
      self,
      root: composer.Entity,
      position: Sequence[float],
      yaw: float = 0.0,
      spread: Sequence[float] = (0.0, 0.0),
  ) -> None:
    """Puts the register into a world.

    Args:
      root: The root entity of the task, usually its arena.
      position: Where the register stands, `(x, y)` in metres.
      yaw: The angle of the axis that carries the value to the world's x axis,
        radians.
      spread: Half-widths of the region around `position`, `(x, y)` in metres in
        the register's frame, in which it stands at random in each episode.
    """
    self._spread = np.array(spread, float)
    frame = root.attach(self)
    frame.pos = [*position, 0.0]
    if yaw:
      frame.quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    for block in self._blocks:
      if isinstance(block, block_kinds.MocapBlock):
        block.attach_to(root, position, yaw)

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    for block in self._blocks:
      if isinstance(block, block_kinds.MocapBlock):
        block.detach_from_root()
    self.detach()

  def initialize_episode(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    """Takes where the register stands now as its original place.

    The task has placed things by now.
    """
    displacement = np.zeros(2)
    if self._spread.any():
      displacement = random_state.uniform(-self._spread, self._spread)
    self.settle(physics, displacement)

  def settle(
      self, physics: protocols.Physics, displacement: np.ndarray
  ) -> None:
    """Fixes the place that writes are relative to, and writes `initial`.

    Args:
      physics: One world, or many.
      displacement: By how much the register moves first, `(2,)`, metres in its
        own frame.
    """
    first = self._blocks[0]
    origin = np.array(first.position(physics))
    if displacement.any():
      origin[..., :2] += displacement
      first.put(physics, origin)
    self._origin_slot.set(physics, origin)
    self.write(physics, np.full(origin.shape[:-1], self._initial))

  def write(self, physics: protocols.Physics, value: Any) -> np.ndarray:
    """Moves blocks so that they represent `value`.

    The blocks are teleported, upright and at rest, and hands let go of them.
    The whole pose is put right, not just the axis that carries the value: a
    block that was carried beside a wall would otherwise be written into it.

    Args:
      physics: One world, or many.
      value: True feedback in the register's units, shape `(...)`.

    Returns:
      The value that was applied: `value`, or the nearest bound of `value_spec`.
      The difference is saturation, never corruption.

    Raises:
      RegisterValueError: If a value is not finite, or if it is out of range and
        the register does not saturate. Nothing has been written.
    """
    value = np.asarray(value, np.float64)[()]
    fits = (value >= self._low) & (value <= self._high)  # NaN does not.
    applied = value if axes.everywhere(fits) else self._saturate(value, fits)
    self._put(physics, applied)
    self._applied_slot.set(physics, applied)
    if self._channel == 'secure':
      self._stored_slot.set(physics, applied)
    return applied

  def _saturate(self, value: np.ndarray, fits: np.ndarray) -> np.ndarray:
    """Returns the nearest value that can be stored, where `value` cannot."""
    is_finite = np.isfinite(value)
    if not is_finite.all():
      raise self._refusal(value, ~is_finite, 'allowed are finite values')
    if self._on_overflow == 'error':
      raise self._refusal(
          value, ~fits, f'its range is [{self._low}, {self._high}]'
      )
    return np.where(fits, value, np.clip(value, self._low, self._high))[()]

  def _refusal(
      self, value: np.ndarray, is_wrong: np.ndarray, allowed: str
  ) -> errors.RegisterValueError:
    """Returns the error about the first wrong value."""
    world = int(np.argmax(is_wrong)) if np.ndim(value) else None
    first = np.asarray(value).flat[world or 0]
    return errors.RegisterValueError(
        f'register {self.name!r}: cannot store {first}; {allowed}', world
    )

  def read(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value that the register represents now, shape `(...)`."""
    if self._channel == 'secure':
      return self._stored_slot.copy(physics)
    return np.array(self._look(physics))[()]

  def applied(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value that was applied last, shape `(...)`."""
    return self._applied_slot.copy(physics)

  def keep(self, physics: protocols.Physics) -> np.ndarray:
    """Returns what to write so that the register keeps its value, `(...)`.

    What physics that have failed left of the value may be out of range.
    """
    return np.clip(self.applied(physics), self._low, self._high)[()]

  def inspect(
      self,
      physics: protocols.Physics,
      reader: str = records.EVALUATOR,
      step: Any = 0,
  ) -> records.Read:
    """Reads the register and splits the corruption of the reading.

    This is for evaluators: agents and providers get the reading alone.

    Args:
      physics: One world, or many.
      reader: Name of the reader, for the record.
      step: Control step of the record, `(...)`.
    """
    reading = self.read(physics)
    if self._channel == 'secure':
      permanent = np.zeros_like(reading)
    else:
      permanent = self._permanent(physics)
    temporary = reading - self._applied_slot.get(physics) - permanent
    return records.Read(self._name, reader, step, reading, permanent, temporary)

  def _origin(self, physics: protocols.Physics) -> np.ndarray:
    """Where the first block stood at the start, `(..., 3)`, metres."""
    return self._origin_slot.get(physics)

  def _add_block(
      self, name: str, class_name: str, position: Sequence[float]
  ) -> block_kinds.Block:
    """Adds a block of the kind that the register's channel asks for.

    Args:
      name: The name of the block within the register.
      class_name: What the ray sense takes it for.
      position: Where it rests in the register's frame, `(x, y)` in metres.
    """
    index = int(class_name == 'offset_block')
    looks = appearance.geom_style(
        class_name, appearance.ROLE_COLOURS[self._role][index]
    )
    half_size = self._block_size / 2
    if self._channel == 'welded':
      return block_kinds.MocapBlock(
          f'{self.name}_{name}', position, half_size, looks
      )
    kind = (
        block_kinds.FreeBlock
        if self._dof == 'free'
        else block_kinds.PlanarBlock
    )
    return kind(self._mjcf_root, name, position, half_size, self._mass, looks)


def _check(
    name: str,
    value_range: Sequence[float],
    scale: float,
    initial: float,
    role: str,
    channel: str,
    dof: str,
    on_overflow: str,
) -> None:
  """Refuses what would build another register than was asked for."""
  allowed = (
      ('role', role, tuple(appearance.ROLE_COLOURS)),
      ('channel', channel, CHANNELS),
      ('dof', dof, DOFS),
      ('on_overflow', on_overflow, OVERFLOWS),
  )
  for what, given, choices in allowed:
    if given not in choices:
      raise errors.SpecError(
          f'register {name!r}: {what}: {given!r}; allowed are {list(choices)}'
      )
  if len(value_range) != 2 or not value_range[0] < value_range[1]:
    raise errors.SpecError(
        f'register {name!r}: value_range: {value_range!r}; allowed are two'
        ' numbers, low < high'
    )
  low, high = value_range
  if not (np.isfinite(low) and np.isfinite(high) and low <= initial <= high):
    raise errors.SpecError(
        f'register {name!r}: initial {initial!r} in value_range'
        f' {value_range!r}; both have to be finite, and initial in the range'
    )
  if not (np.isfinite(scale) and scale > 0):
    raise errors.SpecError(
        f'register {name!r}: scale: {scale!r}; allowed are numbers above 0'
    )

"""Base class for registers: writes, reads and the corruption of readings.

A register is any physical object that stores a value in a physical property
(paper, section 3.1). Everything that moves the object changes the value, so
this package contains no corruption function.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import arguments as register_arguments
from realab_suite.entities.registers import checks
from realab_suite.entities.registers import footprints
from realab_suite.entities.registers import records


@final
class RegisterObservables(composer.Observables):
  """Observables of a register; disabled by default."""

  @composer.observable
  def reading(self) -> observable.Generic:
    return observable.Generic(self._entity.read)


class Register(modelled.ModelledEntity):
  """Base class for registers, which store numbers in the poses of blocks.

  A register is one subtree that can be attached to the root entity of any task:
  `register.attach_to(arena, (x, y))`. It works in a plain Composer environment
  as well as in the environments of this package.

  A subclass builds its blocks in `_build_blocks`, says where they are for a
  value in `_places`, and computes the represented value in `_read_blocks`. If
  values turn blocks, or leave some of them alone, it overrides `_put`; if a
  write changes less than the poses of the blocks, `_shift`. If a write does not
  restore the coordinates that carry the value of all blocks, it returns the
  resulting permanent corruption in `_permanent`.

  A register stores one number, of the shape `(...)`, unless its class names
  several *ports*:

      class Abacus(registers.Register):
        PORTS = 'upper', 'lower'

  Its values and readings then have the shape `(..., ports)`, wherever this
  class says `(...)`, and one write sets all of them. Everything outside the
  register sees each port as a scalar register, `<register>_<port>`; see
  `ports`. Masks of worlds keep the shape `(...)`.

  Attributes:
    PORTS: Names of the ports; none for a register that stores one number, which
      is its own port.
  """

  PORTS: ClassVar[tuple[str, ...]] = ()

  def _build(
      self,
      name: str,
      *,
      arguments: register_arguments.Arguments | None = None,
      **options: Any,
  ) -> None:
    """Builds the register.

    Args:
      name: Name of the register, and of its model until it is attached to a
        model that has another one of that name.
      arguments: Its arguments, as a design has validated them; or `None`.
      **options: Otherwise its arguments by name; see `Arguments`. The range is
        `value_range`.

    Raises:
      SpecError: If an argument has a value that is not allowed.
    """
    if arguments is None:
      if 'value_range' in options:
        options['range'] = options.pop('value_range')
      arguments = validation.validate(
          register_arguments.Arguments, options, f'register {name!r}'
      )
    checks.check_ports(name, self.PORTS)
    # Not the name of the model, which changes if the register is attached to a
    # model that has another one of that name.
    self._name = name
    self._low, self._high = arguments.range
    self._scale = arguments.scale
    self._initial = arguments.constant_initial
    self._role = arguments.role
    self._channel = arguments.channel or 'embedded'
    self._dof = arguments.dof or 'free'
    self._on_overflow = arguments.on_overflow
    self._write = arguments.write
    self._block_size = arguments.block_size
    self._mass = arguments.mass
    self._spread = np.zeros(2)
    self._mjcf_root = mjcf.RootElement(model=name)
    size = len(self.PORTS) or None
    self._applied_slot = state.Slot(self._mjcf_root, 'applied', size)
    self._stored_slot = state.Slot(self._mjcf_root, 'stored', size)
    self._obstruction_slot = state.Slot(self._mjcf_root, 'obstruction', size)
    self._clean_slot = state.Slot(self._mjcf_root, 'clean', size)
    self._origin_slot = state.Slot(self._mjcf_root, 'origin', 3)
    self._blocks = self._build_blocks()
    self._borrowed: block_kinds.Block | None = None
    self._measure_initial: Callable[[Any], np.ndarray] | None = None

  def _build_observables(self) -> RegisterObservables:
    return RegisterObservables(self)

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

  def nearest(self, value: Any) -> Any:
    """Returns the values that a write of values applies, `(...)`.

    Kinds that cannot store every number of their range override this method, so
    that rounding counts as saturation.

    Args:
      value: Values in the range, `(...)`; or nan, which stays.
    """
    return value

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

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the permanent corruption, `(...)`, in the register's units.

    It is the corruption that readings have immediately after a write.
    """
    return np.zeros_like(self._applied_slot.get(physics))

  @property
  def name(self) -> str:
    """Name of the register in its design."""
    return self._name

  @property
  def role(self) -> str:
    """Role of the register, a key of `appearance.ROLE_COLOURS`."""
    return self._role

  @property
  def channel(self) -> str:
    """Channel of the register: `embedded` or `secure`."""
    return self._channel

  @property
  def scale(self) -> float:
    """Length in m (angle in rad for an orientation) per unit of value."""
    return self._scale

  @property
  def value_range(self) -> tuple[float, float]:
    """Lowest and highest value that can be stored."""
    return self._low, self._high

  @property
  def blocks(self) -> list[block_kinds.Block]:
    """Blocks of the register; the first one marks its position."""
    return self._blocks

  @property
  def own_blocks(self) -> list[block_kinds.Block]:
    """Blocks that are no blocks of the world."""
    return [block for block in self._blocks if block is not self._borrowed]

  def footprint(self, physics: protocols.Physics) -> list[footprints.Path]:
    """Returns where writes put the blocks in this episode, if undisturbed.

    Worlds in which something that nothing can push, or another register, is in
    the way of a path are refused. The paths must contain the poses of all
    values of the range, and lines of sight if the kind looks along some.

    This base class tries 257 values. A kind whose blocks jump, or move to and
    fro between two of these values, has to override this method; a kind whose
    blocks move along a line overrides it to be loaded faster. With ports,
    all of them get the same value, so a kind with a block that depends on more
    than one port has to override it, too.

    Args:
      physics: One world; the blocks are moved.
    """
    return footprints.sampled(
        physics,
        self._blocks,
        self.value_range,
        lambda value: self.pose(physics, value),
    )

  def check_sight(self, physics: protocols.Physics) -> None:
    """Refuses blocks that are not seen as they are placed, and moves them."""

  @property
  def spread(self) -> np.ndarray:
    """Half-widths of the region of start positions, `(2,)`, in m."""
    return self._spread

  @property
  def value_spec(self) -> specs.BoundedArray:
    """Spec of a value, float64, bounded by `value_range`.

    Its shape is `()`, or `(ports,)`.
    """
    return specs.BoundedArray(
        self._shape, np.float64, self._low, self._high, name=self.name
    )

  @property
  def _shape(self) -> tuple[int, ...]:
    """Shape of a value in one world."""
    return (len(self.PORTS),) if self.PORTS else ()

  def attach_to(
      self,
      root: composer.Entity,
      position: Sequence[float],
      yaw: float = 0.0,
      spread: Sequence[float] = (0.0, 0.0),
      block: block_kinds.Block | None = None,
  ) -> None:
    """Attaches the register to the root entity of a task.

    Args:
      root: Root entity of the task, usually its arena.
      position: Position of the register, `(x, y)`, in m; or `(x, y, z)` for a
        register on a surface of the height z, such as a table.
      yaw: Angle of the register's axis, which carries the value, to the x axis
        of the world, in rad.
      spread: Half-widths of the region around `position` from which each
        episode draws the start position, `(x, y)` in the register's frame, in
        m.
      block: Block of the world, in a frame with this position and yaw, that the
        register uses instead of its own base block. The register then begins
        where the block does.

    Raises:
      SpecError: If this kind of register cannot use a block of the world.
    """
    if block is not None:
      self.check_can_use_a_block()
    self._spread = np.array(spread, float)
    frame = root.attach(self)
    x, y, height = (*position, 0.0)[:3]
    frame.pos = [x, y, height]
    if yaw:
      frame.quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    reach = np.array([self._low, self._high]) * self._scale
    for own in self._blocks:
      own.surroundings.limit(
          reach[0] - spread[0], reach[1] + spread[0], spread[1]
      )
      if isinstance(own, block_kinds.PlanarBlock):
        own.stand_at(height)
    if block is not None:
      self._use_block(root, block)
      self._borrowed = block

  def check_can_use_a_block(self) -> None:
    """Checks that the register can use a block of the world.

    Raises:
      SpecError: If its kind does not override `_use_block`, or it uses a block
        of the world already.
    """
    if type(self)._use_block is Register._use_block:
      problem = f'{type(self).__name__} has no base block'
    elif self._borrowed is not None:
      problem = 'it uses another block already'
    else:
      return
    raise errors.SpecError(
        f'register {self._name!r}: cannot use a block of the world: {problem};'
        ' allowed are kinds with a base block, embedded or secure, such as'
        ' two_block, and other places'
    )

  def _use_block(self, root: composer.Entity, block: block_kinds.Block) -> None:
    """Replaces the base block by a block of the world, in `blocks` as well.

    Kinds with a base block may override this method. The register is attached.

    Args:
      root: Root entity of the task.
      block: Block of the world.
    """
    raise NotImplementedError  # See `check_can_use_a_block`.

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    self.detach()

  def initialize_episode(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    """Draws the start position from the spread and calls `settle`.

    Composer calls this after the task has initialized the episode.
    """
    displacement = np.zeros(2)
    if self._spread.any() and self._borrowed is None:
      displacement = random_state.uniform(-self._spread, self._spread)
    self.settle(physics, displacement)

  def settle(
      self,
      physics: protocols.Physics,
      displacement: np.ndarray,
      is_initialized: bool = True,
  ) -> None:
    """Sets the origin that writes are relative to, and applies `initial`.

    Args:
      physics: One world or a batch of worlds.
      displacement: Displacement of the register from its current position, in
        its own frame, `(2,)`, in m.
      is_initialized: False if the task has not initialized an episode, so that
        functions of the task have no value yet; what the kind reads is checked
        then, and by each later `inspect`.

    Raises:
      SpecError: If the register reads anything but values of its spec.
    """
    first = self._blocks[0]
    origin = np.array(first.position(physics))
    if displacement.any():
      origin[..., :2] += displacement
      first.put(physics, origin)
    self._origin_slot.set(physics, origin)
    shape = (*origin.shape[:-1], *self._shape)
    initial = np.array(self._initial)
    if self._measure_initial is not None and is_initialized:
      initial = self._start_value(self._measure_initial, physics, shape)
    self.pose(physics, np.full(shape, initial))
    if not is_initialized:
      self.inspect(physics)  # Refuses a wrong kind before any episode.

  def start_with(self, initial: Callable[[Any], np.ndarray]) -> None:
    """Sets a function that returns the value at the start of each episode.

    Args:
      initial: Function of the physics, called after the task has initialized
        the episode. It returns values of shape `(...)`, or with ports
        `(..., ports)` or `(..., 1)`, which are saturated to the range.
    """
    self._measure_initial = initial

  def _start_value(
      self,
      measure: Callable[[Any], np.ndarray],
      physics: protocols.Physics,
      shape: tuple[int, ...],
  ) -> np.ndarray:
    """Returns the value at the start of an episode, `(...)`.

    Args:
      measure: What `start_with` was given.
      physics: One world or a batch of worlds.
      shape: Shape of the value.

    Raises:
      RegisterValueError: If it is not finite, or out of the range of a register
        that does not saturate.
    """
    try:
      value = np.asarray(measure(physics), np.float64)
      value = np.broadcast_to(value, shape)
    except Exception as error:  # The function is a task's.
      raise errors.RegisterValueError(
          f'register {self._name!r}: the function of its initial value:'
          f' {type(error).__name__}: {error}; allowed are numbers of the shape'
          f' {shape}'
      ) from error
    fits = (value >= self._low) & (value <= self._high)
    return value if axes.everywhere(fits) else self._saturate(value, fits)

  def pose(self, physics: protocols.Physics, value: Any) -> None:
    """Moves the blocks to the undisturbed poses that represent a value.

    Unlike `write`, this restores the whole pose of the blocks, and obstacles
    have no influence.

    Args:
      physics: One world or a batch of worlds.
      value: Value within the range, `(...)`, in the register's units; or, in
        one world, a number for all ports.
    """
    value = self.nearest(np.asarray(value, np.float64)[()])
    if self.PORTS:
      value = np.broadcast_to(value, (*value.shape[:-1], *self._shape))
    self._put(physics, value)
    self._store(physics, value, 0.0)

  def write(
      self, physics: protocols.Physics, value: Any, where: axes.Mask = None
  ) -> np.ndarray:
    """Moves the blocks so that they represent a value.

    A write changes the coordinate along the register's axis (the angle about
    the vertical for an orientation) and nothing else: other coordinates,
    velocities and the grip of a hand stay as they are. If a block would be
    inside an immovable object, it gets the nearest free coordinate; see
    `obstruction`. If the register was built with `write='pose'`, a write
    restores the whole pose instead, at rest, and releases the block.

    Args:
      physics: One world or a batch of worlds.
      value: Requested value, `(...)`, in the register's units. Values of worlds
        that are not written are ignored.
      where: Worlds in which the register is written, `(...)` bool; `None` for
        all worlds. In the other worlds, nothing changes.

    Returns:
      Applied value of the last write, `(...)`: `value`, or the nearest bound of
      `value_spec`, and then what `nearest` returns for it. The difference is
      saturation, never corruption.

    Raises:
      RegisterValueError: If a value is not finite or has a wrong shape, or if
        it is out of range and the register does not saturate. Nothing is
        written.
    """
    value = np.asarray(value, np.float64)[()]
    if self.PORTS and value.shape[-1:] != self._shape:
      raise errors.RegisterValueError(
          f'register {self._name!r}: cannot store shape {value.shape}; allowed'
          f' is a value for each of its ports {list(self.PORTS)}'
      )
    if where is not None:  # An ignored value must not be refused.
      is_used = where[..., np.newaxis] if self.PORTS else where
      value = np.where(is_used, value, self._initial)
    fits = (value >= self._low) & (value <= self._high)  # False for NaN.
    applied = value if axes.everywhere(fits) else self._saturate(value, fits)
    applied = self.nearest(applied)
    if self._write == 'pose':
      self._put(physics, applied, where)
      placed = applied
    else:
      placed = self._shift(physics, applied, where)
    is_placed = placed is applied or self._channel == 'secure'
    obstruction = 0.0 if is_placed else placed - applied
    self._store(physics, applied, obstruction, where)
    return applied if where is None else self.applied(physics)

  def _store(
      self,
      physics: protocols.Physics,
      applied: np.ndarray,
      obstruction: Any,
      where: axes.Mask = None,
  ) -> None:
    """Stores the result of a write, whose value is clean for now."""
    self._applied_slot.set(physics, applied, where)
    self._clean_slot.set(physics, applied, where)
    self._obstruction_slot.set(physics, obstruction, where)
    if self._channel == 'secure':
      self._stored_slot.set(physics, applied, where)

  def _saturate(self, value: np.ndarray, fits: np.ndarray) -> np.ndarray:
    """Returns the values, saturated to the range of the register.

    Raises:
      RegisterValueError: If the register refuses a value.
    """
    is_finite = np.isfinite(value)
    if not is_finite.all():
      raise checks.refusal(
          self._name, value, ~is_finite, 'allowed are finite values', self.PORTS
      )
    if self._on_overflow == 'error':
      raise checks.refusal(
          self._name,
          value,
          ~fits,
          f'its range is [{self._low}, {self._high}]',
          self.PORTS,
      )
    return np.where(fits, value, np.clip(value, self._low, self._high))[()]

  def read(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the reading, `(...)`, in the register's units.

    Args:
      physics: One world or a batch of worlds.
    """
    if self._channel == 'secure':
      return self._stored_slot.copy(physics)
    return np.array(self._read_blocks(physics))[()]

  def applied(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the applied value of the last write, `(...)`.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._applied_slot.copy(physics)

  def clean(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the clean content, `(...)`, in the register's units.

    It is what the register would contain if only writers had acted on it and on
    everything that its writer reads. It is for evaluators; neither agents nor
    providers get it.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._clean_slot.copy(physics)

  def set_clean(
      self, physics: protocols.Physics, value: Any, where: axes.Mask = None
  ) -> None:
    """Sets the clean content where it differs from the applied value.

    A write sets it to the applied value. The blocks do not move.

    Args:
      physics: One world or a batch of worlds.
      value: Requested value, `(...)`, which is saturated and rounded as in a
        write; nan if the content is unknown.
      where: Worlds in which to set it, `(...)` bool; `None` for all worlds.
    """
    # Faster than `np.clip` for numbers; a nan stays.
    value = self.nearest(np.minimum(np.maximum(value, self._low), self._high))
    self._clean_slot.set(physics, value, where)

  def obstruction(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the obstruction of the last write, `(...)`.

    It is the value that the blocks got minus the applied value. It differs from
    0 if something immovable was in the way of a block, for instance because an
    agent has carried the block beside a wall.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._obstruction_slot.copy(physics)

  def displacements(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the distance by which each block has moved, `(..., blocks)`.

    It is the distance in m from the position that the reset and the last write
    gave the block, in any direction, and is computed from the blocks even if
    the register is secure.

    Args:
      physics: One world or a batch of worlds.
    """
    places = self._places(physics, self._applied_slot.get(physics))
    moved = [
        np.linalg.norm(block.position(physics) - place, axis=-1)
        for block, place in zip(self._blocks, places, strict=True)
    ]
    return np.stack(moved, axis=-1)

  def inspect(
      self,
      physics: protocols.Physics,
      reader: str = records.EVALUATOR,
      step: Any = 0,
  ) -> records.Read:
    """Returns a reading with the parts of its corruption.

    This method is for evaluators. Agents and providers get only the reading.

    Args:
      physics: One world or a batch of worlds.
      reader: Name of the reader, for the record.
      step: Control step of the read, `(...)`, int, for the record.

    Raises:
      SpecError: If the register reads anything but values of its spec.
    """
    reading = self.read(physics)
    applied = self._applied_slot.get(physics)
    if self._channel == 'secure':
      permanent = np.zeros_like(reading)
    else:
      permanent = np.asarray(self._permanent(physics))[()]
    obstruction = self._obstruction_slot.copy(physics)
    if reading.shape != applied.shape or reading.dtype != np.float64:
      raise checks.misreading(self, '_read_blocks', reading, applied)
    if permanent.shape != applied.shape:
      raise checks.misreading(self, '_permanent', permanent, applied)
    temporary = reading - applied - obstruction - permanent
    return records.Read(
        self._name,
        reader,
        step,
        reading,
        obstruction,
        permanent,
        temporary,
        self._clean_slot.copy(physics),
    )

  def _origin(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the start position of the first block, `(..., 3)`, in m."""
    return self._origin_slot.get(physics)

  def _add_block(
      self,
      name: str,
      class_name: str,
      position: Sequence[float],
      direction: tuple[float, float] | None = None,
      ports: Sequence[str] = (),
  ) -> block_kinds.Block:
    """Adds a block with the register's degrees of freedom.

    Args:
      name: Name of the block within the register.
      class_name: Class that the ray sense reports: `block_kinds.BASE_BLOCK` or
        `block_kinds.OFFSET_BLOCK`.
      position: Position at rest in the register's frame, `(x, y)`, in m.
      direction: Direction of the motion that raises the reading, if there is
        one; see `block_kinds.Block.direction`.
      ports: Ports that depend on the block; all, if none are named. Attribution
        charges permanent corruption of a port to the last mover of its first
        block, and temporary corruption to that of its last one.
    """
    style = self._style(class_name)
    half_size = self._block_size / 2
    kind = (
        block_kinds.FreeBlock
        if self._dof == 'free'
        else block_kinds.PlanarBlock
    )
    return kind(
        self._mjcf_root,
        name,
        position,
        half_size,
        self._mass,
        style,
        direction,
        ports,
    )

  def _style(self, class_name: str) -> dict[str, Any]:
    """Returns geom attributes of a block of a class; see `_add_block`."""
    index = int(class_name == block_kinds.OFFSET_BLOCK)
    colour = appearance.ROLE_COLOURS[self._role][index]
    return appearance.geom_style(class_name, colour)

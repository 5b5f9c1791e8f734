"""Base class for registers: writes, reads and the corruption of readings.

A register is any physical object that stores a value in a physical property
(paper, section 3.1). Everything that moves the object changes the value, so
this package contains no corruption function.
"""

from collections.abc import Callable, Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import arguments as register_arguments
from realab_suite.entities.registers import checks
from realab_suite.entities.registers import kinds
from realab_suite.entities.registers import records

# In rad; MuJoCo does not read subnormal numbers.
_LEAST_YAW = 1e-300


@final
class RegisterObservables(composer.Observables):
  """Observables of a register; disabled by default."""

  @composer.observable
  def reading(self) -> observable.Generic:
    return observable.Generic(self._entity.read)


class Register(kinds.Kind):
  """Base class for registers, which store numbers in the poses of blocks.

  A register is one subtree that can be attached to the root entity of any task:
  `register.attach_to(arena, (x, y))`. It works in a plain Composer environment
  as well as in the environments of this package. `kinds.Kind` has the methods
  that a subclass overrides.
  """

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
    self._block_size = arguments.block_size
    self._mass = arguments.mass
    self._spread = np.zeros(2)
    self._mjcf_root = mjcf.RootElement(model=name)
    size = len(self.PORTS) or None
    self._slots = state.Slots(
        self._mjcf_root,
        applied=size,
        stored=size,
        obstruction=size,
        clean=size,
        origin=3,
    )
    self._blocks = self._build_blocks()
    self._borrowed: block_kinds.Block | None = None
    self._measure_initial: Callable[[protocols.Physics], Any] | None = None

  def _build_observables(self) -> RegisterObservables:
    return RegisterObservables(self)

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
  def initial(self) -> float:
    """Value at the start of an episode, unless `start_with` sets a function."""
    return self._initial

  @property
  def blocks(self) -> list[block_kinds.Block]:
    """Blocks of the register; the first one marks its position."""
    return self._blocks

  @property
  def own_blocks(self) -> list[block_kinds.Block]:
    """Blocks that are no blocks of the world."""
    return [block for block in self._blocks if block is not self._borrowed]

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
    """
    self._spread = np.array(spread, float)
    frame = root.attach(self)
    x, y, height = (*position, 0.0)[:3]
    frame.pos = [x, y, height]
    if abs(yaw) > _LEAST_YAW:
      frame.quat = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    reach = np.array([self._low, self._high]) * self._scale
    low, high = reach[0] - spread[0], reach[1] + spread[0]
    for block in self._blocks:
      block.surroundings.limit(low, high)
      if isinstance(block, block_kinds.PlanarBlock):
        block.stand_at(height)

  def borrow(self, root: composer.Entity, block: block_kinds.Block) -> None:
    """Uses a block of the world instead of the register's own base block.

    Episodes then begin with the register where the block is.

    Args:
      root: Root entity of the task, to which the register is attached.
      block: The block, in a frame with the register's position and yaw.

    Raises:
      SpecError: If this kind of register cannot use a block of the world.
    """
    self.check_can_use_a_block()
    self._use_block(root, block)
    self._borrowed = block

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    self.detach()

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Draws the start position from the spread, and applies `initial`.

    Composer calls this after the task has initialized the episode.
    """
    if self._spread.any() and self._borrowed is None:
      self.move(physics, random_state.uniform(-self._spread, self._spread))
    else:
      self.settle(physics)
    self.start(physics)

  def settle(self, physics: protocols.Physics) -> None:
    """Sets the origin that writes are relative to: where the first block is.

    Args:
      physics: One world or a batch of worlds.
    """
    origin = self._blocks[0].position(physics)
    self._slots.of(physics).origin[...] = origin

  def move(self, physics: protocols.Physics, displacement: np.ndarray) -> None:
    """Moves the first block, and the origin with it.

    Args:
      physics: One world or a batch of worlds.
      displacement: Displacement in the register's frame, `(2,)`, in m.
    """
    first = self._blocks[0]
    origin = np.array(first.position(physics))
    origin[..., :2] += displacement
    first.put(physics, origin)
    self._slots.of(physics).origin[...] = origin

  def start(self, physics: protocols.Physics) -> None:
    """Poses the blocks for the value at the start of an episode.

    Args:
      physics: One world or a batch of worlds, in which the task has initialized
        the episode.

    Raises:
      RegisterValueError: If the function of `start_with` fails.
    """
    worlds = self._slots.of(physics).origin.shape[:-1]
    shape = (*worlds, *self._shape)
    initial = np.array(self._initial)
    if self._measure_initial is not None:
      initial = self._saturated(
          checks.start_value(self._name, self._measure_initial, physics, shape)
      )
    self.pose(physics, np.full(shape, initial))

  def start_with(self, initial: Callable[[protocols.Physics], Any]) -> None:
    """Sets a function that returns the value at the start of each episode.

    Args:
      initial: Function of the physics, called after the task has initialized
        the episode. It returns values of shape `(...)`, or with ports
        `(..., ports)` or `(..., 1)`, which are saturated to the range.
    """
    self._measure_initial = initial

  def pose(self, physics: protocols.Physics, value: Any) -> None:
    """Moves the blocks to the undisturbed poses that represent a value.

    Unlike `write`, this ignores obstacles.

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
    `obstruction`. Kinds without `_shift` restore the whole pose instead, at
    rest, and release the block.

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
      RegisterValueError: If a value is not finite or has a wrong shape.
        Nothing is written.
    """
    value = np.asarray(value, np.float64)[()]
    if self.PORTS and value.shape[-1:] != self._shape:
      raise errors.RegisterValueError(
          f'register {self._name!r}: cannot store shape {value.shape}; must'
          f' have a value for each of its ports {list(self.PORTS)}'
      )
    if where is not None:  # An ignored value must not be refused.
      is_used = where[..., np.newaxis] if self.PORTS else where
      value = np.where(is_used, value, self._initial)
    applied = self.nearest(self._saturated(value))
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
    slots = self._slots.of(physics)
    contents = [
        (slots.applied, applied),
        (slots.clean, applied),
        (slots.obstruction, obstruction),
    ]
    if self._channel == 'secure':
      contents.append((slots.stored, applied))
    for array, value in contents:
      array[...] = value if where is None else axes.merge(where, value, array)

  def _saturated(self, value: np.ndarray) -> np.ndarray:
    """Returns values, `(...)`, saturated to the range."""
    fits = (value >= self._low) & (value <= self._high)  # False for NaN.
    if axes.everywhere(fits):
      return value
    checks.refuse_infinite(value, self._name, self.PORTS)
    return np.where(fits, value, np.clip(value, self._low, self._high))[()]

  def read(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the reading, `(...)`, in the register's units.

    Args:
      physics: One world or a batch of worlds.
    """
    if self._channel == 'secure':
      return self._slots.of(physics).stored.copy()[()]
    return np.array(self._read_blocks(physics))[()]

  def applied(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the applied value of the last write, `(...)`.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._slots.of(physics).applied.copy()[()]

  def clean(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the clean content, `(...)`, in the register's units.

    It is what the register would contain if only writers had acted on it and on
    everything that its writer reads. It is for evaluators; neither agents nor
    providers get it.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._slots.of(physics).clean.copy()[()]

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
    clean = self._slots.of(physics).clean
    clean[...] = axes.merge(where, value, clean)

  def obstruction(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the obstruction of the last write, `(...)`.

    It is the value that the blocks got minus the applied value. It differs from
    0 if something immovable was in the way of a block, for instance because an
    agent has carried the block beside a wall.

    Args:
      physics: One world or a batch of worlds.
    """
    return self._slots.of(physics).obstruction.copy()[()]

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
    slots = self._slots.of(physics)
    applied = slots.applied[()]
    reading = self.read(physics)
    if self._channel == 'secure':
      permanent = np.zeros_like(reading)
    else:
      permanent = np.asarray(self._permanent(physics))[()]
    obstruction = slots.obstruction.copy()[()]
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
        slots.clean.copy()[()],
    )

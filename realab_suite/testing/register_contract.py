"""Contract of registers: what every kind of register promises."""

from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics
from realab_suite.engine import snapshots
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.testing import contracts

# Kinds of blocks: channel, dof and yaw of each register that is tried.
_VARIETIES = (
    ('embedded', 'free', 0.0),
    ('embedded', 'planar', 0.7),
    ('secure', 'free', 0.7),
)
# Default of registers, in m or rad per unit.
_SCALE = 0.1
# Largest rounding error of a reading, in units, and of a position, in m.
_ROUNDING = 1e-9
_NUM_VALUES = 9
# Substeps of rest, and the largest change of a value meanwhile, in units.
_REST, _AT_REST = 80, 1e-6
_NUM_SHOVES = 3
# Half-widths of the region of start positions, in m.
_SPREAD = (0.1, 0.05)
_NUM_WORLDS = 3
# Distance by which a block is displaced in a test, and the least distance that
# has to be reported for it, in m.
_MOVED, _LEAST = 0.05, 0.025
# Widths of ranges, in m or rad, about a turn: a rotation does not tell angles
# apart that differ by a turn.
_WIDE = (6.2, 7.0)
_DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


def check_register(
    kind: type[registers.Register],
    *,
    value_range: tuple[float, float] = (-2.0, 5.0),
    **options: Any,
) -> None:
  """Checks that a kind of register keeps the contract of registers.

  It is built with blocks of every kind, and in every channel.

  - It stores each value of its range, or what `nearest` returns for it, and the
    nearest bound of others. A value that is not finite is refused, and nothing
    changes.
  - Its readings have the shape and dtype of its values. A look at a register
    changes nothing, and later writes change no earlier reading.
  - A range of 6.2 or 7 m or rad is either stored as well, or refused by a
    `SpecError` when the register is made.
  - If it is read from a distance, nothing is in the way in an empty world.
  - Undisturbed blocks keep each value, so they are clear of each other.
  - A write removes temporary corruption, and keeps permanent corruption.
  - A block that is moved in any direction is a displacement, and some motion of
    some block changes each reading. A port depends on its own blocks only, and
    the `direction` of a block raises a reading.
  - Nothing that happens to blocks changes the reading of a secure register.
  - A reset restores everything. A write to some worlds of a batch is the same
    as in these worlds alone, and changes no other world.

  Args:
    kind: Class of the register.
    value_range: Lowest and highest value.
    **options: Further arguments of the class.

  Raises:
    ContractError: If it does not, with the first part that it breaks.
  """
  options['value_range'] = value_range
  world = _World(kind, options)
  for register in world.registers:
    subject = _Subject(register, world, _where(register))
    _check_values(subject)
    _check_looks(subject)
    _check_shoves(subject)
    if register.channel == 'embedded':
      _check_rest(subject)
      _check_displacements(subject)
    world.restart()
    before = snapshots.get_state(world.physics)
    register.write(world.physics, subject.values[-1])
    _shove(subject, np.random.default_rng(0))
    world.restart()
    contracts.require(
        np.array_equal(snapshots.get_state(world.physics), before),
        f'{subject.where}: a reset does not restore everything',
    )
  _check_batch(world)
  for width in _WIDE:
    for is_upward in (True, False):
      _check_wide_range(kind, options, width, is_upward)


@final
class _World:
  """World with a register of every variety, out of reach of one another."""

  def __init__(
      self, kind: type[registers.Register], options: dict[str, Any]
  ) -> None:
    low, high = options['value_range']
    spacing = 2.0 + 2 * (high - low) * options.get('scale', _SCALE)
    arena = arenas.OpenRoom(half_width=spacing)
    self.registers = []
    for i, (channel, dof, yaw) in enumerate(_VARIETIES):
      register = kind(f'r{i}', **options, channel=channel, dof=dof)
      place = spacing * ((i % 2) - 0.5), spacing * ((i // 2) - 0.5)
      register.attach_to(arena, place, yaw, _SPREAD)
      self.registers.append(register)
    blocks = [b for register in self.registers for b in register.blocks]
    if any(
        block_kinds.find_misfit(b, block_kinds.LONG_SUBSTEP) for b in blocks
    ):
      arena.mjcf_model.option.timestep = block_kinds.SHORT_SUBSTEP
    else:
      arena.mjcf_model.option.timestep = block_kinds.LONG_SUBSTEP
    self.physics = single_physics.ThinPhysics.from_mjcf_model(arena.mjcf_model)
    self.restart()

  def restart(self) -> None:
    """Begins an episode."""
    with self.physics.reset_context():
      for register in self.registers:
        register.initialize_episode(self.physics, np.random.RandomState(0))


@final
class _Subject(NamedTuple):
  """A register in a world.

  Attributes:
    register: The register.
    world: Its world.
    where: Description of the register, for messages.
  """

  register: registers.Register
  world: _World
  where: str

  @property
  def physics(self) -> single_physics.ThinPhysics:
    """The world."""
    return self.world.physics

  @property
  def values(self) -> np.ndarray:
    """Values of the range, `(values, ...)`; those of ports differ."""
    low, high = self.register.value_range
    values = self.register.nearest(np.linspace(low, high, _NUM_VALUES))
    if not self.register.PORTS:
      return values
    shifted = [np.roll(values, i) for i in range(len(self.register.PORTS))]
    return np.stack(shifted, axis=-1)

  def read(self) -> np.ndarray:
    """Returns the reading."""
    return self.register.read(self.physics)

  def write(self, value: Any) -> np.ndarray:
    """Writes a value and returns the applied one."""
    return self.register.write(self.physics, value)


def _where(register: registers.Register) -> str:
  name = type(register).__name__
  return f'{name}, {register.channel} with {type(register.blocks[0]).__name__}'


def _are_close(first: Any, second: Any) -> bool:
  return np.allclose(first, second, rtol=0, atol=_ROUNDING)


def _check_values(subject: _Subject) -> None:
  """Checks that the register stores values, saturates and refuses."""
  register, where = subject.register, subject.where
  spec = register.value_spec
  contracts.require(
      len({*register.PORTS}) == len(register.PORTS),
      f'{where}: PORTS names a port twice: {register.PORTS}',
  )
  low, high = register.value_range
  for value in subject.values:
    applied, reading = subject.write(value), subject.read()
    contracts.require(
        np.array_equal(applied, value),
        f'{where}: write({value}) returned {applied}',
    )
    for look in (applied, reading):
      contracts.require(
          type(look) in (np.ndarray, np.float64)
          and (look.shape, look.dtype) == (spec.shape, np.float64),
          f'{where}: {look!r}; values are float64 of the shape {spec.shape}',
      )
    contracts.require(
        _are_close(reading, value), f'{where}: {value} is read as {reading}'
    )
  for value in np.random.default_rng(0).uniform(low, high, _NUM_VALUES):
    near = register.nearest(np.full(spec.shape, value)[()])
    applied = subject.write(np.full(spec.shape, value))
    contracts.require(
        np.array_equal(applied, near)
        and np.array_equal(register.nearest(near), near),
        f'{where}: write({value}) returned {applied}, and nearest {near}, for'
        f' which it returns {register.nearest(near)}',
    )
  for beyond, bound in ((low - 1.0, low), (high + 1.0, high)):
    applied = subject.write(np.full(spec.shape, beyond))
    contracts.require(
        np.all(applied == bound) and _are_close(subject.read(), bound),
        f'{where}: {beyond} was applied as {applied}, not saturated to {bound}',
    )
  before = snapshots.get_state(subject.physics)
  for value in (np.nan, np.inf):
    try:
      subject.write(np.full(spec.shape, value))
    except errors.RegisterValueError:
      pass
    else:
      raise contracts.ContractError(f'{where}: {value} is not refused')
  contracts.require(
      np.array_equal(snapshots.get_state(subject.physics), before),
      f'{where}: a refused value changes the world',
  )


def _check_wide_range(
    kind: type[registers.Register],
    options: dict[str, Any],
    width: float,
    is_upward: bool,
) -> None:
  """Checks that a register stores each value of a wide range, or refuses it.

  Args:
    kind: Class of the register.
    options: Arguments of the class.
    width: Width of the range, in m or rad.
    is_upward: True to raise the upper end of the range, False to lower the
      lower end.
  """
  low, high = options['value_range']
  units = width / options.get('scale', _SCALE)
  if is_upward:
    high = max(high, low + units)
  else:
    low = min(low, high - units)
  try:
    world = _World(kind, {**options, 'value_range': (low, high)})
  except errors.SpecError:
    return
  [register, *_] = world.registers
  try:
    _check_values(_Subject(register, world, _where(register)))
  except contracts.ContractError as error:
    raise contracts.ContractError(
        f'{error}; the range was [{low:g}, {high:g}]. A range with values that'
        ' the blocks cannot tell apart, such as angles of more than a turn, has'
        ' to be refused by a SpecError when the register is made'
    ) from error


def _check_looks(subject: _Subject) -> None:
  """Checks that looks change nothing and stay what they were."""
  register, physics = subject.register, subject.physics
  where = subject.where
  subject.write(subject.values[1])
  _shove(subject, np.random.default_rng(0))
  physics.forward()
  before = snapshots.get_state(physics)
  without = register.read_without(physics, lambda geoms: geoms >= 0)
  contracts.require(
      without is None or np.array_equal(without, subject.read()),
      f'{where}: in an empty world, it reads {subject.read()}, and {without}'
      ' without what is in the way',
  )
  looks = [
      subject.read(),
      register.applied(physics),
      register.displacements(physics),
      register.inspect(physics).permanent,
  ]
  contracts.require(
      np.array_equal(snapshots.get_state(physics), before),
      f'{where}: a look at the register changes the world',
  )
  kept = [np.copy(look) for look in looks]
  subject.write(subject.values[-2])
  for look, was in zip(looks, kept, strict=True):
    contracts.require(
        np.array_equal(look, was), f'{where}: a later write changes a reading'
    )


def _shove(subject: _Subject, generator: np.random.Generator) -> None:
  """Pushes, lifts and turns every block of a register, at random."""
  physics = subject.physics
  for block in subject.register.blocks:
    body = physics.model.geom_bodyid[physics.bind(block.geom).element_id]
    force = generator.uniform((-40, -40, 0, -2, -2, -2), (40, 40, 30, 2, 2, 2))
    force *= physics.model.body_mass[body]
    physics.data.xfrc_applied[body] = force
    physics.advance(8)
    physics.data.xfrc_applied[body] = 0.0


def _check_shoves(subject: _Subject) -> None:
  """Checks what remains of the value when blocks are pushed."""
  register, physics = subject.register, subject.physics
  where = subject.where
  generator = np.random.default_rng(0)
  value = subject.values[2]
  for _ in range(_NUM_SHOVES):
    subject.write(value)
    reading = subject.read()
    _shove(subject, generator)
    if register.channel != 'embedded':
      contracts.require(
          np.array_equal(subject.read(), reading),
          f'{where}: the reading changed from {reading} to {subject.read()}',
      )
    before = register.inspect(physics).permanent
    subject.write(value)
    after = register.inspect(physics)
    contracts.require(
        _are_close(after.temporary, 0.0),
        f'{where}: a write leaves a temporary corruption of {after.temporary};'
        ' _permanent returns what a write cannot undo',
    )
    contracts.require(
        _are_close(after.permanent, before),
        f'{where}: a write changes the permanent corruption from {before} to'
        f' {after.permanent}',
    )


def _check_rest(subject: _Subject) -> None:
  """Checks that physics alone changes no value."""
  for value in subject.values[:: _NUM_VALUES // 4]:
    subject.world.restart()
    subject.write(value)
    subject.physics.advance(_REST)
    reading = subject.read()
    contracts.require(
        np.allclose(reading, value, rtol=0, atol=_AT_REST),
        f'{subject.where}: {value} is read as {reading} after {_REST} substeps'
        ' in which nobody has touched the blocks; keep them apart, or exclude'
        ' their contact as two_block does',
    )


def _check_displacements(subject: _Subject) -> None:
  """Checks the consequences of the motion of a single block."""
  register, physics = subject.register, subject.physics
  where = subject.where
  changed = np.zeros(register.value_spec.shape, bool)
  for i, block in enumerate(register.blocks):
    direction, named = block.direction, block.ports or register.PORTS
    depends = np.array([port in named for port in register.PORTS] or True)
    # A register of few levels may not notice less than the size of a block.
    size = 2 * block.half_size
    for x, y in (*_DIRECTIONS, *([direction] if direction else [])):
      far = _displaced(subject, block, (x * size, y * size))
      changed |= np.abs(far) > _ROUNDING
      difference = _displaced(subject, block, (_MOVED * x, _MOVED * y))
      reported = register.displacements(physics)[i]
      contracts.require(
          reported >= _LEAST,
          f'{where}: block {i} was moved by {_MOVED} m in the direction'
          f' {(x, y)}, and displacements reports {reported} m; override it',
      )
      contracts.require(
          _are_close(difference[~depends], 0.0),
          f'{where}: block {i} changes other ports than {named}',
      )
      changed |= np.abs(difference) > _ROUNDING
    if direction:
      contracts.require(
          difference.max() > _ROUNDING,
          f'{where}: block {i} was moved in its direction {direction}, and the'
          f' reading changed by {difference}; the direction of a block'
          ' raises a reading',
      )
    changed |= np.abs(_displaced(subject, block, turn=0.1)) > _ROUNDING
  fixed = [p for i, p in enumerate(register.PORTS) if not changed[i]]
  contracts.require(
      changed.all(),
      f'{where}: no motion of a single block changes'
      f' {fixed or "the reading"}',
  )


def _displaced(
    subject: _Subject,
    block: block_kinds.Block,
    displacement: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
) -> np.ndarray:
  """Displaces a block after a write; returns the change of the reading."""
  subject.world.restart()
  subject.write(subject.values[2])
  reading = subject.read()
  place = np.array(block.position(subject.physics))
  place[:2] += displacement
  block.put(subject.physics, place, block.heading(subject.physics) + turn)
  return np.asarray(subject.read() - reading)


def _check_batch(world: _World) -> None:
  """Checks that worlds of a batch are written as they would be alone."""
  world.restart()
  batch = batch_physics.BatchPhysics(world.physics, _NUM_WORLDS, 1, False)
  begun = np.tile(snapshots.get_state(world.physics), (_NUM_WORLDS, 1))
  batch.set_state(np.arange(_NUM_WORLDS), begun)
  where = np.array([True, False, True])
  for register in world.registers:
    subject = _Subject(register, world, _where(register))
    values = subject.values[1 : 1 + _NUM_WORLDS]
    register.write(batch, subject.values[-_NUM_WORLDS:])
    before = register.read(batch)
    register.write(batch, values, where)
    readings = register.read(batch)
    contracts.require(
        np.array_equal(readings[~where], before[~where]),
        f'{subject.where}: a write to other worlds of a batch changes a world',
    )
    for i in np.flatnonzero(where):
      world.restart()
      subject.write(subject.values[-_NUM_WORLDS:][i])
      subject.write(values[i])
      alone = subject.read()
      contracts.require(
          np.array_equal(readings[i], alone),
          f'{subject.where}: {values[i]} is read as {readings[i]} in a batch,'
          f' and as {alone} in one world',
      )

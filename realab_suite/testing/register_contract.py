"""Contract of registers: what every kind of register promises."""

from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics
from realab_suite.engine import snapshots
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.entities import state
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
    contract = _Contract(register, world)
    contract.check_values()
    contract.check_looks()
    contract.check_shoves()
    if register.channel == 'embedded':
      contract.check_rest()
      contract.check_displacements()
    contract.check_restart()
  for register in world.registers:
    _Contract(register, world).check_batch()
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
    substep = block_kinds.LONG_SUBSTEP
    blocks = [b for register in self.registers for b in register.blocks]
    if any(block_kinds.find_misfit(block, substep) for block in blocks):
      substep = block_kinds.SHORT_SUBSTEP
    arena.mjcf_model.option.timestep = substep
    state.make_room(arena.mjcf_model)
    self.physics = single_physics.ThinPhysics.from_mjcf_model(arena.mjcf_model)
    self.restart()

  def restart(self) -> None:
    """Begins an episode."""
    with self.physics.reset_context():
      for register in self.registers:
        register.initialize_episode(self.physics, np.random.RandomState(0))


@final
class _Contract:
  """The checks of a register in a world."""

  def __init__(self, register: registers.Register, world: _World) -> None:
    self._register = register
    self._world = world
    self._physics = world.physics
    low, high = register.value_range
    values = register.nearest(np.linspace(low, high, _NUM_VALUES))
    if register.PORTS:  # Those of ports differ.
      shifted = [np.roll(values, i) for i in range(len(register.PORTS))]
      values = np.stack(shifted, axis=-1)
    self._values = values

  def _require(self, condition: Any, breach: str) -> None:
    register = self._register
    kind, blocks = type(register).__name__, type(register.blocks[0]).__name__
    contracts.require(
        condition, f'{kind}, {register.channel} with {blocks}: {breach}'
    )

  def _read(self) -> np.ndarray:
    return self._register.read(self._physics)

  def _write(self, value: Any) -> np.ndarray:
    return self._register.write(self._physics, value)

  def _state(self) -> np.ndarray:
    return snapshots.get_state(self._physics)

  def check_values(self) -> None:
    """Checks that the register stores values, saturates and refuses."""
    register, spec = self._register, self._register.value_spec
    self._require(
        len({*register.PORTS}) == len(register.PORTS),
        f'PORTS names a port twice: {register.PORTS}',
    )
    low, high = register.value_range
    for value in self._values:
      applied, reading = self._write(value), self._read()
      self._require(
          np.array_equal(applied, value), f'write({value}) returned {applied}'
      )
      for look in (applied, reading):
        self._require(
            type(look) in (np.ndarray, np.float64)
            and (look.shape, look.dtype) == (spec.shape, np.float64),
            f'{look!r}; values are float64 of the shape {spec.shape}',
        )
      self._require(_are_close(reading, value), f'{value} is read as {reading}')
    for value in np.random.default_rng(0).uniform(low, high, _NUM_VALUES):
      near = register.nearest(np.full(spec.shape, value)[()])
      applied = self._write(np.full(spec.shape, value))
      self._require(
          np.array_equal(applied, near)
          and np.array_equal(register.nearest(near), near),
          f'write({value}) returned {applied}, and nearest {near}, for which it'
          f' returns {register.nearest(near)}',
      )
    for beyond, bound in ((low - 1.0, low), (high + 1.0, high)):
      applied = self._write(np.full(spec.shape, beyond))
      self._require(
          np.all(applied == bound) and _are_close(self._read(), bound),
          f'{beyond} was applied as {applied}, not saturated to {bound}',
      )
    before = self._state()
    for value in (np.nan, np.inf):
      is_refused = False
      try:
        self._write(np.full(spec.shape, value))
      except errors.RegisterValueError:
        is_refused = True
      self._require(is_refused, f'{value} is not refused')
    self._require(
        np.array_equal(self._state(), before),
        'a refused value changes the world',
    )

  def check_looks(self) -> None:
    """Checks that looks change nothing and stay what they were."""
    register, physics = self._register, self._physics
    self._write(self._values[1])
    self._shove(np.random.default_rng(0))
    physics.forward()
    before = self._state()
    without = register.read_without(physics, lambda geoms: geoms >= 0)
    self._require(
        without is None or np.array_equal(without, self._read()),
        f'in an empty world, it reads {self._read()}, and {without} without'
        ' what is in the way',
    )
    looks = [
        self._read(),
        register.applied(physics),
        register.displacements(physics),
        register.inspect(physics).permanent,
    ]
    self._require(
        np.array_equal(self._state(), before),
        'a look at the register changes the world',
    )
    kept = [np.copy(look) for look in looks]
    self._write(self._values[-2])
    self._require(
        all(map(np.array_equal, looks, kept)), 'a later write changes a reading'
    )

  def _shove(self, generator: np.random.Generator) -> None:
    """Pushes, lifts and turns every block of the register, at random."""
    physics, most = self._physics, np.array([40, 40, 30, 2, 2, 2])
    for block in self._register.blocks:
      body = physics.model.geom_bodyid[physics.bind(block.geom).element_id]
      force = generator.uniform(-most * [1, 1, 0, 1, 1, 1], most)
      physics.data.xfrc_applied[body] = force * physics.model.body_mass[body]
      physics.advance(8)
      physics.data.xfrc_applied[body] = 0.0

  def check_shoves(self) -> None:
    """Checks what remains of the value when blocks are pushed."""
    generator = np.random.default_rng(0)
    value = self._values[2]
    for _ in range(_NUM_SHOVES):
      self._write(value)
      reading = self._read()
      self._shove(generator)
      self._require(
          self._register.channel == 'embedded'
          or np.array_equal(self._read(), reading),
          f'the reading changed from {reading} to {self._read()}',
      )
      before = self._register.inspect(self._physics).permanent
      self._write(value)
      after = self._register.inspect(self._physics)
      self._require(
          _are_close(after.temporary, 0.0),
          f'a write leaves a temporary corruption of {after.temporary};'
          ' _permanent returns what a write cannot undo',
      )
      self._require(
          _are_close(after.permanent, before),
          f'a write changes the permanent corruption from {before} to'
          f' {after.permanent}',
      )

  def check_rest(self) -> None:
    """Checks that physics alone changes no value."""
    for value in self._values[:: _NUM_VALUES // 4]:
      self._world.restart()
      self._write(value)
      self._physics.advance(_REST)
      reading = self._read()
      self._require(
          np.allclose(reading, value, rtol=0, atol=_AT_REST),
          f'{value} is read as {reading} after {_REST} substeps in which nobody'
          ' has touched the blocks; keep them apart, or exclude their contact'
          ' as two_block does',
      )

  def check_displacements(self) -> None:
    """Checks the consequences of the motion of a single block."""
    register = self._register
    changed = np.zeros(register.value_spec.shape, bool)
    for i, block in enumerate(register.blocks):
      direction, named = block.direction, block.ports or register.PORTS
      depends = np.array([port in named for port in register.PORTS] or True)
      # A register of few levels may not notice less than the size of a block.
      size = 2 * block.half_size
      for way in (*_DIRECTIONS, *([direction] if direction else [])):
        changed |= self._displaced(block, size * np.array(way)) != 0.0
        difference = self._displaced(block, _MOVED * np.array(way))
        reported = register.displacements(self._physics)[i]
        self._require(
            reported >= _LEAST,
            f'block {i} was moved by {_MOVED} m in the direction {way}, and'
            f' displacements reports {reported} m; override it',
        )
        self._require(
            np.all(difference[~depends] == 0.0),
            f'block {i} changes other ports than {named}',
        )
        changed |= difference != 0.0
      self._require(
          not direction or difference.max() > 0.0,
          f'block {i} was moved in its direction {direction}, and the reading'
          f' changed by {difference}; the direction of a block raises a'
          ' reading',
      )
      changed |= self._displaced(block, np.zeros(2), turn=0.1) != 0.0
    fixed = [p for i, p in enumerate(register.PORTS) if not changed[i]]
    self._require(
        changed.all(),
        f'no motion of a single block changes {fixed or "the reading"}',
    )

  def _displaced(
      self,
      block: block_kinds.Block,
      displacement: np.ndarray,
      turn: float = 0.0,
  ) -> np.ndarray:
    """Displaces a block after a write.

    Returns:
      The change of the reading, without rounding errors.
    """
    self._world.restart()
    self._write(self._values[2])
    reading = self._read()
    place = np.array(block.position(self._physics))
    place[:2] += displacement
    block.put(self._physics, place, block.heading(self._physics) + turn)
    change = np.asarray(self._read() - reading)
    return np.where(np.abs(change) > _ROUNDING, change, 0.0)

  def check_restart(self) -> None:
    """Checks that a reset undoes writes and pushes."""
    self._world.restart()
    before = self._state()
    self._write(self._values[-1])
    self._shove(np.random.default_rng(0))
    self._world.restart()
    self._require(
        np.array_equal(self._state(), before),
        'a reset does not restore everything',
    )

  def check_batch(self) -> None:
    """Checks that worlds of a batch are written as they would be alone."""
    self._world.restart()
    batch = batch_physics.BatchPhysics(self._physics, _NUM_WORLDS, 1, False)
    begun = np.tile(self._state(), (_NUM_WORLDS, 1))
    batch.set_state(np.arange(_NUM_WORLDS), begun)
    where = np.array([True, False, True])
    first = self._values[-_NUM_WORLDS:]
    second = self._values[1 : 1 + _NUM_WORLDS]
    self._register.write(batch, first)
    before = self._register.read(batch)
    self._register.write(batch, second, where)
    readings = self._register.read(batch)
    self._require(
        np.array_equal(readings[~where], before[~where]),
        'a write to other worlds of a batch changes a world',
    )
    for i in np.flatnonzero(where):
      self._world.restart()
      self._write(first[i])
      self._write(second[i])
      alone = self._read()
      self._require(
          np.array_equal(readings[i], alone),
          f'{second[i]} is read as {readings[i]} in a batch, and as {alone} in'
          ' one world',
      )


def _are_close(first: Any, second: Any) -> bool:
  return np.allclose(first, second, rtol=0, atol=_ROUNDING)


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
    _Contract(register, world).check_values()
  except contracts.ContractError as error:
    raise contracts.ContractError(
        f'{error}; the range was [{low:g}, {high:g}]. A range with values that'
        ' the blocks cannot tell apart, such as angles of more than a turn, has'
        ' to be refused by a SpecError when the register is made'
    ) from error

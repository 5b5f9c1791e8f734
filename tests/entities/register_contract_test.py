"""What every register promises, whatever its kind, channel, freedom and place.

All of them stand in one world, each out of reach of the others, so that a test
of a hundred values costs no more than the stepping.
"""

import itertools
from typing import Any, NamedTuple

from dm_control import composer
from dm_control import mjcf
import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from tests import examples
from tests import worlds

_KINDS = {
    'two_block': registers.TwoBlockRegister,
    'block_position': registers.BlockPositionRegister,
    'block_orientation': registers.BlockOrientationRegister,
}
_LOW, _HIGH, _INITIAL = -2.0, 5.0, 1.5
_SCALE = 0.1
# What a float64 loses on its way into a pose and back.
_ROUNDING = 1e-12
_SPACING = 1.4


class Variety(NamedTuple):
  """Everything that a register's promises must not depend on."""

  kind: str
  channel: str
  dof: str
  yaw: float

  @property
  def name(self) -> str:
    return f'{self.kind}_{self.channel}_{self.dof}_{self.yaw:g}'.replace(
        '.', '_'
    )


_VARIETIES = [
    Variety(*each)
    for each in itertools.product(
        _KINDS, registers.CHANNELS, registers.DOFS, (0.0, 0.7)
    )
]


class World(NamedTuple):
  """A compiled world with one register of every variety."""

  physics: mjcf.Physics
  registers: dict[str, registers.Register]

  def restart(self, seed: int = 0) -> None:
    worlds.start_episode(self.physics, *self.registers.values(), seed=seed)


def _make(variety: Variety, **options: Any) -> registers.Register:
  return _KINDS[variety.kind](
      variety.name,
      value_range=(_LOW, _HIGH),
      scale=_SCALE,
      initial=_INITIAL,
      channel=variety.channel,
      dof=variety.dof,
      **options,
  )


def _world(
    kind: type[mjcf.Physics] = mjcf.Physics,
    spread: tuple[float, float] = (0.0, 0.0),
    **options: Any,
) -> World:
  columns = int(np.ceil(np.sqrt(len(_VARIETIES))))
  arena = arenas.OpenRoom(half_width=_SPACING * columns / 2)
  corner = -_SPACING * (columns - 1) / 2
  made = {}
  for i, variety in enumerate(_VARIETIES):
    register = _make(variety, **options)
    row, column = divmod(i, columns)
    place = (corner + _SPACING * column, corner + _SPACING * row)
    register.attach_to(arena, place, variety.yaw, spread)
    made[variety.name] = register
  return World(worlds.compile_world(arena, kind), made)


@pytest.fixture(
    scope='module',
    name='compiled',
    params=[mjcf.Physics, single_physics.ThinPhysics],
    ids=['any_physics', 'our_physics'],
)
def fixture_compiled(request):
  return _world(request.param)


@pytest.fixture(name='world')
def fixture_world(compiled):
  compiled.restart()
  return compiled


@pytest.fixture(scope='module', name='strict')
def fixture_strict():
  return _world(on_overflow='error')


every_variety = pytest.mark.parametrize(
    'variety', _VARIETIES, ids=[variety.name for variety in _VARIETIES]
)
every_kind = pytest.mark.parametrize('kind', _KINDS)


def _shove_everything(world, random_state, register):
  """Pushes, lifts and turns every block of a register, at random."""
  for block in register.blocks:
    worlds.shove(
        world.physics,
        block,
        random_state.uniform((-40, -40, 0), (40, 40, 30)),
        random_state.uniform(-2, 2, 3),
    )


# ---- Writing and reading -----------------------------------------------------


@every_variety
@hypothesis.given(value=st.floats(_LOW, _HIGH))
@hypothesis.example(value=0.0)
@hypothesis.example(value=_LOW)
@hypothesis.example(value=_HIGH)
@examples.settings(10)
def test_what_is_written_is_read(compiled, variety, value):
  register = compiled.registers[variety.name]
  worlds.start_episode(compiled.physics, register)
  assert register.write(compiled.physics, value) == value
  assert register.applied(compiled.physics) == value
  assert register.read(compiled.physics) == pytest.approx(value, abs=_ROUNDING)
  corruption = register.inspect(compiled.physics)
  assert corruption.permanent == 0.0
  assert corruption.temporary == pytest.approx(0.0, abs=_ROUNDING)


@every_variety
@hypothesis.given(
    value=st.one_of(
        st.floats(max_value=_LOW, allow_infinity=False),
        st.floats(min_value=_HIGH, allow_infinity=False),
    )
)
@examples.settings(5)
def test_a_value_out_of_range_is_saturated_and_the_writer_is_told(
    compiled, variety, value
):
  register = compiled.registers[variety.name]
  worlds.start_episode(compiled.physics, register)
  bound = np.clip(value, _LOW, _HIGH)
  assert register.write(compiled.physics, value) == bound
  assert register.applied(compiled.physics) == bound
  assert register.read(compiled.physics) == pytest.approx(bound, abs=_ROUNDING)


@every_variety
@pytest.mark.parametrize('value', [np.nextafter(_HIGH, 9), -40.0])
def test_a_register_that_does_not_saturate_refuses(strict, variety, value):
  strict.restart()
  before = worlds.state_bytes(strict.physics)
  with pytest.raises(
      errors.RegisterValueError,
      match=rf'{variety.name}.* {value}.*\[{_LOW}, {_HIGH}\]',
  ):
    strict.registers[variety.name].write(strict.physics, value)
  assert worlds.state_bytes(strict.physics) == before


@every_variety
def test_a_register_that_does_not_saturate_stores_its_bounds(strict, variety):
  strict.restart()
  register = strict.registers[variety.name]
  for bound in (_LOW, _HIGH):
    assert register.write(strict.physics, bound) == bound


@pytest.mark.parametrize(('value', 'bound'), [(0.0, 1.0), (1.5, 1.5), (4, 3)])
def test_a_range_without_zero_is_saturated_at_the_nearest_bound(value, bound):
  arena = arenas.OpenRoom()
  register = registers.TwoBlockRegister(
      'positive', value_range=(1.0, 3.0), initial=2.0
  )
  register.attach_to(arena, (0.0, 0.0))
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  assert register.write(physics, value) == bound


@every_variety
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(world, variety, value):
  before = worlds.state_bytes(world.physics)
  with pytest.raises(
      errors.RegisterValueError, match=rf'{variety.name}.* {value}.*finite'
  ):
    world.registers[variety.name].write(world.physics, value)
  assert worlds.state_bytes(world.physics) == before


@every_variety
def test_what_can_be_stored_is_in_the_value_spec(world, variety):
  spec = world.registers[variety.name].value_spec
  assert spec.shape == ()
  assert spec.dtype == np.float64
  assert (spec.minimum, spec.maximum) == (_LOW, _HIGH)
  assert spec.name == variety.name


@every_variety
def test_looking_changes_nothing(world, variety):
  register = world.registers[variety.name]
  register.write(world.physics, 2.0)
  world.physics.forward()
  before = worlds.state_bytes(world.physics)
  register.read(world.physics)
  register.applied(world.physics)
  register.inspect(world.physics)
  assert worlds.state_bytes(world.physics) == before


@every_variety
def test_what_was_read_stays_what_it_was(world, variety):
  register = world.registers[variety.name]
  register.write(world.physics, 2.0)
  corruption = register.inspect(world.physics)
  looks = [
      register.read(world.physics),
      register.applied(world.physics),
      corruption.permanent,
      corruption.temporary,
  ]
  before = [float(look) for look in looks]
  register.write(world.physics, -1.0)
  _shove_everything(world, np.random.RandomState(0), register)
  register.read(world.physics)
  register.inspect(world.physics)
  assert [float(look) for look in looks] == before


@every_variety
def test_values_are_plain_numpy(world, variety):
  register = world.registers[variety.name]
  corruption = register.inspect(world.physics)
  values = {
      'read': register.read(world.physics),
      'applied': register.applied(world.physics),
      'write': register.write(world.physics, 1.0),
      'permanent': corruption.permanent,
      'temporary': corruption.temporary,
  }
  for name, value in values.items():
    # Arrays of dm_control's own cannot be pickled, nor written to.
    assert type(value) in (np.ndarray, np.float64), (name, type(value))
    assert value.dtype == np.float64, name
    assert value.shape == (), name


def test_a_write_to_one_register_is_no_write_to_another(world):
  values = {}
  random_state = np.random.RandomState(0)
  for name, register in world.registers.items():
    values[name] = random_state.uniform(_LOW, _HIGH)
    register.write(world.physics, values[name])
  for name, register in world.registers.items():
    assert register.read(world.physics) == pytest.approx(
        values[name], abs=_ROUNDING
    )


# ---- What happens to a value -------------------------------------------------


def test_nothing_happens_to_values_that_nobody_tampers_with(world):
  # Campaign C29.
  values = [0.0, _LOW, _HIGH, *np.linspace(_LOW, _HIGH, 47)]
  worst = dict.fromkeys(world.registers, 0.0)
  for value in values:
    for register in world.registers.values():
      register.write(world.physics, value)
    worlds.step(world.physics, 200)
    for name, register in world.registers.items():
      corruption = register.inspect(world.physics)
      error = np.abs(register.read(world.physics) - value)
      moved = np.abs(corruption.permanent) * _SCALE
      worst[name] = max(worst[name], error, moved)
  assert {name: error for name, error in worst.items() if error > 1e-9} == {}


@every_variety
def test_corruption_is_what_the_reading_is_off_by(world, variety):
  register = world.registers[variety.name]
  random_state = np.random.RandomState(0)
  for _ in range(5):
    register.write(world.physics, random_state.uniform(_LOW, _HIGH))
    for _ in range(2):
      _shove_everything(world, random_state, register)
      error = register.read(world.physics) - register.applied(world.physics)
      corruption = register.inspect(world.physics)
      assert error == pytest.approx(
          corruption.permanent + corruption.temporary, abs=1e-9
      )


@every_variety
def test_a_write_mends_what_is_temporary_and_nothing_else(world, variety):
  register = world.registers[variety.name]
  random_state = np.random.RandomState(1)
  for value in (-1.0, 0.0, 3.0):
    _shove_everything(world, random_state, register)
    before = register.inspect(world.physics).permanent
    register.write(world.physics, value)
    after = register.inspect(world.physics)
    assert after.temporary == pytest.approx(0.0, abs=1e-9)
    assert after.permanent == pytest.approx(before, abs=1e-9)
    assert register.read(world.physics) == pytest.approx(
        value + before, abs=1e-9
    )


def _is(channel: str) -> pytest.MarkDecorator:
  chosen = [variety for variety in _VARIETIES if variety.channel == channel]
  return pytest.mark.parametrize(
      'variety', chosen, ids=[variety.name for variety in chosen]
  )


@_is('embedded')
def test_moving_the_blocks_of_an_embedded_register_corrupts_it(world, variety):
  register = world.registers[variety.name]
  register.write(world.physics, 1.0)
  # The last block carries the value, whatever the kind.
  worlds.shove(world.physics, register.blocks[-1], (30, 30, 5), (0, 0, 1))
  assert np.abs(register.read(world.physics) - 1.0) > 0.05


@_is('secure')
def test_nothing_that_is_done_to_the_blocks_corrupts_a_secure_register(
    world, variety
):
  register = world.registers[variety.name]
  register.write(world.physics, 1.1)
  random_state = np.random.RandomState(0)
  before = [
      worlds.world_position(world.physics, block) for block in register.blocks
  ]
  for _ in range(5):
    _shove_everything(world, random_state, register)
    assert register.read(world.physics) == 1.1
    corruption = register.inspect(world.physics)
    assert corruption.permanent == 0.0
    assert corruption.temporary == 0.0
  # The blocks are scenery that moves like that of an embedded register.
  for block, was in zip(register.blocks, before, strict=True):
    assert not np.allclose(worlds.world_position(world.physics, block), was)


@_is('welded')
def test_only_a_write_moves_the_blocks_of_a_welded_register(world, variety):
  register = world.registers[variety.name]
  register.write(world.physics, 1.1)
  worlds.step(world.physics)
  read = register.read(world.physics)
  before = [
      worlds.world_position(world.physics, block) for block in register.blocks
  ]
  random_state = np.random.RandomState(0)
  for _ in range(3):
    _shove_everything(world, random_state, register)
  for block, was in zip(register.blocks, before, strict=True):
    now = worlds.world_position(world.physics, block)
    np.testing.assert_array_equal(now, was)
  assert register.read(world.physics) == read


# ---- Twins: the same register over another channel ---------------------------


@pytest.mark.parametrize('dof', registers.DOFS)
@every_kind
@pytest.mark.parametrize('yaw', [0.0, 0.7])
def test_twins_look_alike_until_somebody_touches_them(world, kind, dof, yaw):
  poses = []
  for channel in registers.CHANNELS:
    register = world.registers[Variety(kind, channel, dof, yaw).name]
    register.write(world.physics, 3.0)
    world.physics.forward()
    first = worlds.world_position(world.physics, register.blocks[0])
    last = worlds.world_position(world.physics, register.blocks[-1])
    poses.append([*(last - first), *_facing(world.physics, register)])
  np.testing.assert_allclose(poses[1:], [poses[0]] * 2, atol=1e-12)


def _facing(physics, register):
  return np.array(physics.bind(register.blocks[-1].geom).xmat)


# ---- Episodes ----------------------------------------------------------------


@every_variety
def test_an_episode_starts_with_the_initial_value(world, variety):
  register = world.registers[variety.name]
  assert register.applied(world.physics) == _INITIAL
  assert register.read(world.physics) == pytest.approx(_INITIAL, abs=_ROUNDING)


@every_variety
def test_everything_is_forgotten_at_a_reset(world, variety):
  start = worlds.state_bytes(world.physics)
  register = world.registers[variety.name]
  register.write(world.physics, 4.0)
  _shove_everything(world, np.random.RandomState(0), register)
  register.write(world.physics, -1.0)
  assert worlds.state_bytes(world.physics) != start
  world.restart()
  assert worlds.state_bytes(world.physics) == start


@pytest.fixture(scope='module', name='scattered')
def fixture_scattered():
  return _world(spread=(0.15, 0.05))


@every_variety
def test_a_scattered_register_stands_where_the_generator_says(
    scattered, variety
):
  register = scattered.registers[variety.name]
  places = []
  for seed in (0, 0, 1, 2):
    scattered.restart(seed)
    corruption = register.inspect(scattered.physics)
    assert corruption.permanent == pytest.approx(0.0, abs=_ROUNDING)
    assert register.write(scattered.physics, 3.0) == 3.0
    assert register.read(scattered.physics) == pytest.approx(3.0, abs=_ROUNDING)
    places.append(register.blocks[0].position(scattered.physics)[:2].copy())
  np.testing.assert_array_equal(places[0], places[1])
  assert not np.allclose(places[0], places[2])
  carried = register.blocks[0] is register.blocks[-1]
  home = [
      3.0 * _SCALE if carried and variety.kind == 'block_position' else 0,
      0,
  ]
  assert (np.abs(np.array(places) - home) <= [0.15 + 1e-9, 0.05 + 1e-9]).all()


# ---- In a task of somebody else's --------------------------------------------


class _WritingTask(composer.NullTask):
  """Writes to registers before each control step."""

  def __init__(self, root, written, values):
    super().__init__(root)
    self._written, self._values = written, iter(values)
    self.value = None
    self.set_timesteps(control_timestep=0.05, physics_timestep=0.005)

  def before_step(self, physics, action, random_state):
    self.value = next(self._values)
    for register in self._written:
      register.write(physics, self.value)


def _plain_arena() -> composer.Arena:
  """An arena of dm_control's own, with its options, and a floor."""
  arena = composer.Arena()
  arena.mjcf_model.worldbody.add('geom', type='plane', size=(9, 9, 0.1))
  return arena


@pytest.mark.parametrize('dof', registers.DOFS)
@pytest.mark.parametrize('channel', registers.CHANNELS)
@every_kind
def test_registers_work_in_a_plain_composer_environment(kind, channel, dof):
  arena = _plain_arena()
  register = _make(Variety(kind, channel, dof, 0.7))
  register.attach_to(arena, (0.3, -0.2), 0.7)
  values = [0.0, _LOW, _HIGH, 1.1, _HIGH]
  task = _WritingTask(arena, [register], values * 2)
  register.observables.reading.enabled = True
  environment = composer.Environment(task, random_state=0)
  key = f'{register.name}/reading'
  for _ in range(2):
    timestep = environment.reset()
    assert timestep.observation[key] == pytest.approx(_INITIAL, abs=_ROUNDING)
    for _ in values:
      timestep = environment.step(environment.action_spec().generate_value())
      # Composer steps once with the forces from before the write.
      assert timestep.observation[key] == pytest.approx(task.value, abs=1e-6)


@every_variety
def test_the_reading_is_hidden_unless_somebody_shows_it(variety):
  arena = _plain_arena()
  register = _make(variety)
  register.attach_to(arena, (0.0, 0.0), variety.yaw)
  environment = composer.Environment(composer.NullTask(arena), random_state=0)
  assert environment.observation_spec() == {}


# ---- In the way of an avatar -------------------------------------------------


@pytest.mark.parametrize('dof', registers.DOFS)
@every_kind
@pytest.mark.parametrize('channel', registers.CHANNELS)
def test_an_avatar_moves_what_is_not_welded(kind, channel, dof):
  arena = arenas.OpenRoom()
  register = _make(Variety(kind, channel, dof, 0.0))
  register.attach_to(arena, (0.0, 0.0))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  avatar.make_graspable(register.blocks)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, register)
  register.write(physics, 0.0)
  # Off centre, so that a block turns as well as slides.
  avatar.place(physics, (-1.0, 0.08), 0.0)
  worlds.step(physics)
  before = worlds.world_position(physics, register.blocks[0])
  read = register.read(physics)
  worlds.act(avatar, physics, 60, forward=1.0, grasp=1.0)
  moved = worlds.world_position(physics, register.blocks[0]) - before
  if channel == 'welded':
    np.testing.assert_array_equal(moved, 0.0)
    assert avatar.position(physics)[0] < 0.0
    assert avatar.holding(physics) == 0.0
  else:
    assert moved[0] > 0.2
  if channel == 'embedded':
    assert np.abs(register.read(physics) - read) > 0.05
  else:
    assert register.read(physics) == read


# ---- Arguments ---------------------------------------------------------------


@every_kind
@pytest.mark.parametrize(
    ('argument', 'value'),
    [
        ('channel', 'secured'),
        ('dof', 'fixed'),
        ('on_overflow', 'clip'),
        ('role', 'reward'),
        ('value_range', (1.0, 1.0)),
        ('value_range', (0.0, np.nan)),
        ('scale', 0.0),
        ('initial', 9.0),
    ],
)
def test_an_argument_that_makes_no_sense_is_refused(kind, argument, value):
  arguments = {'value_range': (0.0, 1.0), argument: value}
  with pytest.raises(errors.SpecError, match='register_1'):
    _KINDS[kind]('register_1', **arguments)


def test_an_orientation_that_could_not_be_told_apart_is_refused():
  with pytest.raises(errors.SpecError, match=r'angle.*\[0.0, 4.0\]'):
    registers.BlockOrientationRegister(
        'angle', value_range=(0.0, 4.0), scale=1.0
    )


def test_a_welded_register_can_stand_at_the_root_of_a_task_only():
  arena, vehicle = _plain_arena(), _plain_arena()
  arena.attach(vehicle)
  register = registers.TwoBlockRegister(
      'reward', value_range=(0.0, 1.0), channel='welded'
  )
  with pytest.raises(errors.SpecError, match='root entity'):
    register.attach_to(vehicle, (0.0, 0.0))


def test_blocks_are_of_the_kind_that_the_channel_asks_for(world):
  for variety in _VARIETIES:
    expected = {
        'free': block_kinds.FreeBlock,
        'planar': block_kinds.PlanarBlock,
    }
    kind = expected[variety.dof]
    if variety.channel == 'welded':
      kind = block_kinds.MocapBlock
    blocks = world.registers[variety.name].blocks
    assert [type(block) for block in blocks] == [kind] * len(blocks)

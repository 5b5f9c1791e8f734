"""Tests of the contract that registers of every variety keep."""

from dm_control import mjcf
import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import examples
from tests import worlds
from tests.entities import register_worlds


@pytest.fixture(
    scope='module',
    name='compiled',
    params=[mjcf.Physics, single_physics.ThinPhysics],
    ids=['any_physics', 'our_physics'],
)
def fixture_compiled(request):
  return register_worlds.make_world(request.param)


@pytest.fixture(name='world')
def fixture_world(compiled):
  compiled.restart()
  return compiled


@pytest.fixture(scope='module', name='strict')
def fixture_strict():
  return register_worlds.make_world(on_overflow='error')


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


@register_worlds.every_variety
@hypothesis.given(value=st.floats(register_worlds.LOW, register_worlds.HIGH))
@hypothesis.example(value=0.0)
@hypothesis.example(value=register_worlds.LOW)
@hypothesis.example(value=register_worlds.HIGH)
@examples.settings(10)
def test_a_read_returns_the_written_value(compiled, variety, value):
  register = compiled.registers[variety.name]
  worlds.start_episode(compiled.physics, register)
  assert register.write(compiled.physics, value) == value
  assert register.applied(compiled.physics) == value
  assert register.read(compiled.physics) == pytest.approx(
      value, abs=register_worlds.ROUNDING
  )
  corruption = register.inspect(compiled.physics)
  assert corruption.permanent == 0.0
  assert corruption.temporary == pytest.approx(
      0.0, abs=register_worlds.ROUNDING
  )


@register_worlds.every_variety
@hypothesis.given(
    value=st.one_of(
        st.floats(max_value=register_worlds.LOW, allow_infinity=False),
        st.floats(min_value=register_worlds.HIGH, allow_infinity=False),
    )
)
@examples.settings(5)
def test_a_value_out_of_range_is_saturated_and_returned(
    compiled, variety, value
):
  register = compiled.registers[variety.name]
  worlds.start_episode(compiled.physics, register)
  bound = np.clip(value, register_worlds.LOW, register_worlds.HIGH)
  assert register.write(compiled.physics, value) == bound
  assert register.applied(compiled.physics) == bound
  assert register.read(compiled.physics) == pytest.approx(
      bound, abs=register_worlds.ROUNDING
  )


@register_worlds.every_variety
def test_a_register_that_does_not_saturate_refuses_more_than_its_bounds(
    strict, variety
):
  strict.restart()
  register = strict.registers[variety.name]
  before = worlds.state_bytes(strict.physics)
  for value in (np.nextafter(register_worlds.HIGH, 9), -40.0):
    with pytest.raises(
        errors.RegisterValueError,
        match=rf'{variety.name}.* {value}.*\[-2.0, 5.0\]',
    ):
      register.write(strict.physics, value)
  assert worlds.state_bytes(strict.physics) == before
  for bound in (register_worlds.LOW, register_worlds.HIGH):
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


@register_worlds.every_variety
def test_non_finite_values_are_rejected(world, variety):
  before = worlds.state_bytes(world.physics)
  for value in (np.nan, np.inf, -np.inf):
    with pytest.raises(
        errors.RegisterValueError, match=rf'{variety.name}.* {value}.*finite'
    ):
      world.registers[variety.name].write(world.physics, value)
  assert worlds.state_bytes(world.physics) == before


@register_worlds.every_variety
def test_the_value_spec_has_the_range(world, variety):
  spec = world.registers[variety.name].value_spec
  assert (spec.shape, spec.dtype, spec.name) == ((), np.float64, variety.name)
  assert (spec.minimum, spec.maximum) == (
      register_worlds.LOW,
      register_worlds.HIGH,
  )


@register_worlds.every_variety
def test_reading_changes_nothing(world, variety):
  register = world.registers[variety.name]
  register.write(world.physics, 2.0)
  world.physics.forward()
  before = worlds.state_bytes(world.physics)
  for look in (register.read, register.applied, register.inspect):
    look(world.physics)
  assert worlds.state_bytes(world.physics) == before


@register_worlds.every_variety
def test_earlier_readings_do_not_change(world, variety):
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


@register_worlds.every_variety
def test_values_are_plain_numpy(world, variety):
  register = world.registers[variety.name]
  found = register.inspect(world.physics)
  for value in (
      register.read(world.physics),
      register.applied(world.physics),
      register.write(world.physics, 1.0),
      found.permanent,
      found.temporary,
  ):
    # Arrays of dm_control's own cannot be pickled, nor written to.
    assert type(value) in (np.ndarray, np.float64)
    assert (value.dtype, value.shape) == (np.float64, ())


def test_a_write_to_one_register_is_no_write_to_another(world):
  values = {}
  random_state = np.random.RandomState(0)
  for name, register in world.registers.items():
    values[name] = random_state.uniform(
        register_worlds.LOW, register_worlds.HIGH
    )
    register.write(world.physics, values[name])
  for name, register in world.registers.items():
    assert register.read(world.physics) == pytest.approx(
        values[name], abs=register_worlds.ROUNDING
    )


# ---- What happens to a value -------------------------------------------------


def test_values_do_not_drift_without_tampering(world):
  values = [0.0, *np.linspace(register_worlds.LOW, register_worlds.HIGH, 9)]
  worst = dict.fromkeys(world.registers, 0.0)
  for value in values:
    for register in world.registers.values():
      register.write(world.physics, value)
    worlds.step(world.physics, 200)
    for name, register in world.registers.items():
      corruption = register.inspect(world.physics)
      error = np.abs(register.read(world.physics) - value)
      moved = np.abs(corruption.permanent) * register_worlds.SCALE
      worst[name] = max(worst[name], error, moved)
  assert {name: error for name, error in worst.items() if error > 1e-9} == {}


@register_worlds.every_variety
def test_corruption_is_reading_minus_applied_value(world, variety):
  register = world.registers[variety.name]
  random_state = np.random.RandomState(0)
  for _ in range(5):
    register.write(
        world.physics,
        random_state.uniform(register_worlds.LOW, register_worlds.HIGH),
    )
    for _ in range(2):
      _shove_everything(world, random_state, register)
      error = register.read(world.physics) - register.applied(world.physics)
      corruption = register.inspect(world.physics)
      parts = (
          corruption.obstruction, corruption.permanent, corruption.temporary
      )  # fmt: skip
      assert error == pytest.approx(sum(parts), abs=1e-9)


@register_worlds.every_variety
def test_a_write_removes_temporary_corruption_only(world, variety):
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
  chosen = [
      variety
      for variety in register_worlds.VARIETIES
      if variety.channel == channel
  ]
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
@register_worlds.every_kind
def test_twins_look_alike_until_they_are_touched(world, kind, dof):
  poses = []
  for channel in registers.CHANNELS:
    register = world.registers[
        register_worlds.variety_of(kind, channel, dof).name
    ]
    register.write(world.physics, 3.0)
    world.physics.forward()
    first = worlds.world_position(world.physics, register.blocks[0])
    last = worlds.world_position(world.physics, register.blocks[-1])
    poses.append([*(last - first), *_facing(world.physics, register)])
  np.testing.assert_allclose(poses[1:], [poses[0]] * 2, atol=1e-12)


def _facing(physics, register):
  return np.array(physics.bind(register.blocks[-1].geom).xmat)


# ---- Episodes ----------------------------------------------------------------


@register_worlds.every_variety
def test_a_reset_restores_the_initial_value_and_everything_else(world, variety):
  register = world.registers[variety.name]
  assert register.applied(world.physics) == register_worlds.INITIAL
  assert register.read(world.physics) == pytest.approx(
      register_worlds.INITIAL, abs=register_worlds.ROUNDING
  )
  start = worlds.state_bytes(world.physics)
  register.write(world.physics, 4.0)
  _shove_everything(world, np.random.RandomState(0), register)
  register.write(world.physics, -1.0)
  assert worlds.state_bytes(world.physics) != start
  world.restart()
  assert worlds.state_bytes(world.physics) == start


@pytest.fixture(scope='module', name='scattered')
def fixture_scattered():
  return register_worlds.make_world(spread=(0.15, 0.05))


@register_worlds.every_variety
def test_the_seed_decides_the_place_of_a_scattered_register(scattered, variety):
  register = scattered.registers[variety.name]
  places = []
  for seed in (0, 0, 1, 2):
    scattered.restart(seed)
    corruption = register.inspect(scattered.physics)
    assert corruption.permanent == pytest.approx(
        0.0, abs=register_worlds.ROUNDING
    )
    assert register.write(scattered.physics, 3.0) == 3.0
    assert register.read(scattered.physics) == pytest.approx(
        3.0, abs=register_worlds.ROUNDING
    )
    places.append(register.blocks[0].position(scattered.physics)[:2].copy())
  np.testing.assert_array_equal(places[0], places[1])
  assert not np.allclose(places[0], places[2])
  carried = register.blocks[0] is register.blocks[-1]
  home = [
      3.0 * register_worlds.SCALE
      if carried and variety.kind == 'block_position'
      else 0,
      0,
  ]
  assert (np.abs(np.array(places) - home) <= [0.15 + 1e-9, 0.05 + 1e-9]).all()

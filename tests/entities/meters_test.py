"""Meters measure the truth; what carries it can be tampered with (M1-M4)."""

from dm_control import composer
import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import meters
from realab_suite.entities import registers
from realab_suite.entities import state
from tests import worlds


class _World:
  """A score, a meter of it, and the register that the meter writes."""

  def __init__(self, channel='embedded', value_range=(0, 10), **options):
    arena = arenas.OpenRoom()
    self.score = state.Slot(arena.mjcf_model, 'score')
    self.register = registers.TwoBlockRegister(
        'score',
        value_range=value_range,
        role='meter',
        channel=channel,
        **options,
    )
    self.register.attach_to(arena, (0.0, 0.0))
    self.meter = meters.Meter(self.score.get, self.register)
    self.physics = worlds.compile_world(arena)
    worlds.start_episode(self.physics, self.register)

  def update(self):
    return self.meter.update(self.physics)

  def read(self):
    return float(self.register.read(self.physics))


@pytest.fixture(name='world')
def fixture_world():
  return _World()


def test_a_meter_writes_its_measurement_on_update(world):
  world.update()
  world.score.set(world.physics, 3.5)
  assert world.read() == pytest.approx(0.0, abs=1e-12)
  measured, applied = world.update()
  assert (measured, applied) == (3.5, 3.5)
  assert world.read() == pytest.approx(3.5, abs=1e-12)
  world.score.set(world.physics, 12.0)
  beyond = world.update()
  assert beyond == (12.0, 10.0)
  assert world.read() == pytest.approx(10.0, abs=1e-12)
  assert (measured, applied) == (3.5, 3.5)


def test_a_measurement_may_be_any_number():
  world = _World()
  meter = meters.Meter(lambda physics: 2, world.register)
  measured, applied = meter.update(world.physics)
  assert measured.dtype == np.float64
  assert applied == 2.0


@pytest.mark.parametrize('dof', registers.DOFS)
def test_a_moved_base_block_falsifies_a_meter_and_not_its_measurement(dof):
  world = _World(dof=dof)
  base, _ = world.register.blocks
  place = np.add(base.position(world.physics), (0.3, 0.0, 0.0))
  base.put(world.physics, place)
  for score in (1.0, 4.0):
    world.score.set(world.physics, score)
    measured, _ = world.update()
    assert measured == score
    assert world.read() == pytest.approx(score - 3.0, abs=1e-12)


def test_a_meter_that_is_attached_alone_writes_in_every_step():
  arena = arenas.OpenRoom()
  register = registers.TwoBlockRegister('time', value_range=(0, 10))
  register.attach_to(arena, (0.0, 0.0))
  meter = meters.Meter(lambda physics: physics.time(), register)
  arena.attach(meter)
  task = composer.NullTask(arena)
  task.set_timesteps(control_timestep=0.1, physics_timestep=0.01)
  environment = composer.Environment(task, random_state=0)
  environment.reset()
  for step in range(1, 4):
    environment.step(np.zeros(environment.action_spec().shape))
    time = float(register.read(environment.physics))
    assert time == pytest.approx(0.1 * step, abs=1e-6)

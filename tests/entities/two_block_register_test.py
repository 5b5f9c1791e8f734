"""The algebra of the paper's primary register (section 3.1; G2 and G10)."""

import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import registers
from tests import worlds

_SCALE = 0.1
_ROUNDING = 1e-12


class _World:
  """A two-block register, and hands that move its blocks as they please."""

  def __init__(self, channel='embedded', dof='free', yaw=0.0):
    arena = arenas.OpenRoom()
    self.register = registers.TwoBlockRegister(
        'reward',
        value_range=(-10, 10),
        scale=_SCALE,
        channel=channel,
        dof=dof,
    )
    self.register.attach_to(arena, (0.3, -0.4), yaw)
    self.physics = worlds.compile_world(arena)
    worlds.start_episode(self.physics, self.register)
    self.base, self.offset = self.register.blocks

  def move(self, block, by):
    place = np.array(block.position(self.physics)) + [*by, 0.0][:3]
    block.put(self.physics, place)

  def write(self, value):
    self.register.write(self.physics, value)

  def read(self):
    return float(self.register.read(self.physics))

  @property
  def parts(self):
    corruption = self.register.inspect(self.physics)
    return float(corruption.permanent), float(corruption.temporary)


@pytest.fixture(name='world', params=registers.DOFS)
def fixture_world(request):
  return _World(dof=request.param, yaw=0.7)


def _approx(value):
  return pytest.approx(value, abs=_ROUNDING)


def test_moving_the_offset_block_corrupts_until_the_next_write(world):
  world.write(2.0)
  world.move(world.offset, (0.3, 0.0))
  assert world.read() == _approx(5.0)
  assert world.parts == _approx((0.0, 3.0))
  world.write(-1.0)
  assert world.read() == _approx(-1.0)
  assert world.parts == _approx((0.0, 0.0))


def test_moving_the_base_block_corrupts_from_then_on(world):
  world.write(2.0)
  world.move(world.base, (0.3, 0.0))
  assert world.read() == _approx(-1.0)
  for value in (2.0, 0.0, -4.0, 4.0):
    world.write(value)
    assert world.read() == _approx(value - 3.0)
    assert world.parts == _approx((-3.0, 0.0))


def test_carrying_both_blocks_along_shows_at_the_next_write(world):
  world.write(1.0)
  for block in (world.base, world.offset):
    world.move(block, (0.3, 0.0))
  assert world.read() == _approx(1.0)
  assert world.parts == _approx((-3.0, 3.0))
  world.write(1.0)
  assert world.read() == _approx(-2.0)
  assert world.parts == _approx((-3.0, 0.0))


def test_only_the_axis_that_carries_the_value_counts(world):
  world.write(2.0)
  world.move(world.base, (0.0, 0.4))
  world.move(world.offset, (0.0, -0.3, 0.5))
  assert world.read() == _approx(2.0)
  assert world.parts == _approx((0.0, 0.0))


def test_a_block_that_is_pushed_corrupts_like_one_that_is_put():
  world = _World()
  world.write(0.0)
  worlds.shove(world.physics, world.base, (0.0, 0.0, 0.0), steps=50)
  worlds.shove(world.physics, world.base, (40.0, 0.0, 0.0), steps=20)
  worlds.step(world.physics, 200)
  permanent, _ = world.parts
  assert permanent < -1.0
  for value in (0.0, 5.0):
    world.write(value)
    # The base block may still creep a little.
    assert world.read() == pytest.approx(value + permanent, abs=1e-6)


@pytest.mark.parametrize(
    ('channel', 'dof'), [('embedded', 'free'), ('secure', 'planar')]
)
def test_the_two_blocks_never_collide_with_each_other(channel, dof):
  world = _World(channel=channel, dof=dof)
  world.write(0.0)
  # Into each other, as an agent that carries one of them can bring them.
  place = np.add(world.base.position(world.physics), (0.05, 0.02, 0.0))
  world.offset.put(world.physics, place)
  world.physics.forward()
  pair = {
      world.physics.bind(block.geom).element_id for block in (
          world.base, world.offset
      )
  }  # fmt: skip
  contacts = world.physics.data.contact
  touching = [set(geoms) for geoms in contacts.geom.tolist()]
  assert pair not in touching


def test_the_yaw_is_the_axis_of_the_value():
  yaw = -2.0
  world = _World(yaw=yaw)
  places = {}
  for value in (0.0, 4.0):
    world.write(value)
    world.physics.forward()
    places[value] = worlds.world_position(world.physics, world.offset)
  expected = 4.0 * _SCALE * np.array([np.cos(yaw), np.sin(yaw), 0.0])
  np.testing.assert_allclose(places[4.0] - places[0.0], expected, atol=1e-9)
  beside = places[0.0] - worlds.world_position(world.physics, world.base)
  # Beside the line of the base block, so that both can be seen.
  assert np.linalg.norm(beside) > 0.2
  assert beside @ [np.cos(yaw), np.sin(yaw), 0.0] == pytest.approx(0, abs=1e-9)


def test_where_the_task_put_the_base_block_is_its_original_place(world):
  with world.physics.reset_context():
    world.move(world.base, (0.2, 0.1))
    world.register.initialize_episode(world.physics, np.random.RandomState(0))
  world.write(3.0)
  assert world.read() == _approx(3.0)
  assert world.parts == _approx((0.0, 0.0))

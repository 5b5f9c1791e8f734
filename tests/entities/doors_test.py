"""The door slides when told to, and cannot be forced."""

import numpy as np
import pytest

from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import doors
from realab_suite.entities import registers
from tests import worlds

_SPEED = 2.0


class _World:
  """Two rooms with a door between them and an avatar that wants through."""

  def __init__(self, *things):
    arena = arenas.TwoRooms()
    self.doorway = arena.places['doorway'].position
    self.width = arena.doorway_width
    self.door = doors.SlidingDoor(width=self.width)
    self.door.attach_to(arena, self.doorway)
    self.avatar = avatars.Avatar()
    arena.attach(self.avatar)
    for thing in things:
      thing.attach_to(arena, (0.0, 0.0))
      self.avatar.make_graspable(thing.blocks)
    self.physics = worlds.compile_world(arena)
    worlds.start_episode(self.physics, self.door)

  def advance(self, opening, seconds):
    self.door.advance(self.physics, np.array(opening), seconds)
    worlds.step(self.physics)

  @property
  def openness(self):
    return float(self.door.openness(self.physics))

  @property
  def slid(self):
    """Returns the distance that the door has slid, metres."""
    return float(self.physics.data.mocap_pos[0, 0]) - self.doorway[0]


@pytest.fixture(name='world')
def fixture_world():
  return _World()


def test_a_door_slides_at_its_speed_until_it_is_open_or_shut(world):
  assert world.openness == 0.0
  for i in range(1, 4):
    world.advance(True, 0.1)
    assert world.slid == pytest.approx(i * 0.1 * _SPEED)
    assert 0.0 < world.openness < 1.0
  world.advance(False, 0.1)
  assert world.slid == pytest.approx(0.2 * _SPEED)
  for _ in range(20):
    world.advance(True, 0.1)
  assert world.openness == pytest.approx(1.0, abs=1e-12)
  # Clear of the doorway, and not much farther.
  assert world.width <= world.slid < 1.1 * world.width
  world.advance(False, 9.0)
  assert world.openness == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(('dof', 'distance'), [('free', 1.33), ('planar', 0.7)])
def test_a_block_that_is_thrown_at_a_shut_door_stays_outside(dof, distance):
  block = registers.BlockPositionRegister('block', value_range=(-9, 9), dof=dof)
  world = _World(block)
  x, y = world.doorway
  place = np.array([x, y - distance])
  world.avatar.place(world.physics, place - [0.0, 0.5], np.pi / 2)
  block.blocks[0].put(world.physics, [*place, block.blocks[0].rest_height])
  worlds.act(world.avatar, world.physics, 30, grasp=1.0)
  assert world.avatar.holding(world.physics) == 1.0
  worlds.act(world.avatar, world.physics, 100, throw=1.0)
  assert worlds.world_position(world.physics, block.blocks[0])[1] < y
  assert world.openness == 0.0


def test_a_closing_door_does_not_throw_the_avatar(world):
  world.advance(True, 9.0)
  world.avatar.place(world.physics, world.doorway, np.pi / 2)
  fastest = 0.0
  for _ in range(100):
    world.advance(False, 0.01)
    speed = np.linalg.norm(world.avatar.velocity(world.physics)[:2])
    fastest = max(fastest, speed)
  assert fastest < 2 * _SPEED
  assert world.openness == pytest.approx(0.0, abs=1e-12)

"""Apples are eaten by coming near, once."""

import numpy as np
import pytest

from realab_suite.entities import appearance
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from tests import worlds

_PLACES = np.array([(1.5, 0.0), (1.5, 0.3), (-2.0, 1.0)])
_REACH = 0.5


class _World:

  def __init__(self, kind=apple_group.APPLE):
    arena = arenas.OpenRoom()
    self.apples = apple_group.Apples(number=len(_PLACES), kind=kind)
    self.apples.attach_to(arena)
    self.avatar = avatars.Avatar(num_rays=33)
    arena.attach(self.avatar)
    self.physics = worlds.compile_world(arena)
    self.restart()

  def restart(self):
    with self.physics.reset_context():
      self.apples.place(self.physics, _PLACES)

  def eat(self, x, y):
    return int(self.apples.eat(self.physics, np.array([x, y]), _REACH))

  @property
  def seen(self):
    """The class of what is straight ahead of the avatar."""
    classes = self.avatar.rays.classes(self.physics)
    return appearance.class_name(classes[len(classes) // 2])


@pytest.fixture(name='world')
def fixture_world():
  return _World()


def test_an_apple_in_reach_is_eaten_once(world):
  for x, y, eaten in [
      (-2.0, 1.0 + _REACH + 1e-9, 0),
      (-2.0, 1.0 + _REACH - 1e-9, 1),
      (-2.0, 1.0, 0),
      (1.5, 0.15, 2),  # Two at once.
  ]:
    assert world.eat(x, y) == eaten
  assert world.apples.num_eaten(world.physics) == len(_PLACES)


def test_an_eaten_apple_is_out_of_sight_at_once(world):
  # A foreign task eats in its `after_step`, and the observation of that step is
  # made before the next.
  assert world.seen == 'apple'
  world.eat(1.5, 0.0)
  assert world.seen == 'wall'
  worlds.step(world.physics)
  assert world.seen == 'wall'


def test_placing_apples_and_resetting_bring_them_back(world):
  for bring_back in (
      lambda: world.apples.place(world.physics, _PLACES),
      world.restart,
  ):
    before = world.apples.num_eaten(world.physics)
    assert world.eat(-2.0, 1.0) == 1
    assert before == 0
    bring_back()
    assert world.apples.num_eaten(world.physics) == 0
    assert world.seen == 'apple'


def test_nothing_collides_with_an_apple(world):
  world.avatar.place(world.physics, (0.5, 0.0), 0.0)
  worlds.act(world.avatar, world.physics, 100, forward=1.0)
  assert world.avatar.position(world.physics)[0] > 2.3
  assert world.avatar.position(world.physics)[1] == pytest.approx(0, abs=1e-9)


def test_groups_may_have_one_name_in_a_world_with_defaults():
  arena = arenas.OpenRoom()
  arena.mjcf_model.default.geom.margin = 0.5
  groups = [apple_group.Apples(number=2), apple_group.Apples(number=3)]
  for group in groups:
    group.attach_to(arena)
  physics = worlds.compile_world(arena)
  for group in groups:
    group.place(physics, np.ones((group.number, 2)))
    geoms = [frame.geom[0] for frame in group.frames]
    assert not physics.bind(geoms).margin.any()  # Not those of the room.
  assert groups[0].eat(physics, np.ones(2), _REACH) == 2
  assert [int(group.num_eaten(physics)) for group in groups] == [2, 0]

"""The pressure pad stays pressed, and shows it."""

import numpy as np
import pytest

from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import pads
from tests import worlds

_PLACE = np.array([1.5, 0.0])
_RADIUS = 0.8


class _World:

  def __init__(self):
    arena = arenas.OpenRoom()
    self.pad = pads.PressurePad(radius=_RADIUS)
    self.pad.attach_to(arena, _PLACE)
    self.avatar = avatars.Avatar(num_rays=33)
    arena.attach(self.avatar)
    self.physics = worlds.compile_world(arena)
    worlds.start_episode(self.physics, self.pad)

  def press(self, x, y):
    self.pad.press(self.physics, np.array([x, y]))
    worlds.step(self.physics)

  @property
  def pressed(self):
    return bool(self.pad.pressed(self.physics))

  @property
  def seen(self):
    classes = self.avatar.rays.classes(self.physics)
    return appearance.class_name(classes[len(classes) // 2])


@pytest.fixture(name='world')
def fixture_world():
  return _World()


@pytest.mark.parametrize(
    ('distance', 'seen'),
    [(_RADIUS + 1e-6, 'pad'), (_RADIUS - 1e-6, 'pressed_pad')],
)
def test_a_pad_is_pressed_by_standing_on_it(world, distance, seen):
  assert not world.pressed
  assert world.seen == 'pad'
  world.press(1.5, distance)
  assert world.pressed == (seen == 'pressed_pad')
  assert world.seen == seen


def test_a_pad_stays_pressed(world):
  world.press(*_PLACE)
  world.press(-3.0, -3.0)
  worlds.step(world.physics, 100)
  assert world.pressed
  assert world.seen == 'pressed_pad'


def test_a_pad_sinks_once(world):
  world.press(*_PLACE)
  depth = world.physics.data.mocap_pos[0, 2]
  assert depth < 0.0
  world.press(*_PLACE)
  assert world.physics.data.mocap_pos[0, 2] == depth


def test_a_reset_releases_the_pad(world):
  world.press(*_PLACE)
  worlds.start_episode(world.physics, world.pad)
  assert not world.pressed
  assert world.seen == 'pad'


def test_an_avatar_can_stand_on_a_pad_and_cannot_walk_through_its_post(world):
  worlds.act(world.avatar, world.physics, 200, forward=1.0)
  x = world.avatar.position(world.physics)[0]
  assert 1.5 - _RADIUS < x < 1.5 - world.avatar.radius
  assert not world.pressed

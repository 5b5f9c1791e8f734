"""Tests that cameras and rays agree (T5). Needs EGL."""

import numpy as np
import pytest

from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import pads
from realab_suite.entities import registers
from tests import worlds

pytestmark = pytest.mark.camera


def _world(*things):
  arena = arenas.OpenRoom()
  for thing, place in things:
    thing.attach_to(arena, place)
  avatar = avatars.Avatar()
  arena.attach(avatar)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, avatar)
  return physics, avatar


def _view(physics, camera):
  """Returns the image of a camera, `(64, 64, 3)`, as floats from 0 to 1."""
  physics.forward()
  return physics.render(64, 64, camera_id=camera.full_identifier) / 255.0


def _count(view, colour):
  """Returns the number of pixels that are mostly of a colour."""
  index = 'red green blue'.split().index(colour)
  others = np.delete(view, index, axis=-1).max(axis=-1)
  return int((view[..., index] > 2 * others).sum())


def test_an_apple_is_seen_until_it_is_eaten():
  apples = apple_group.Apples(number=1)
  physics, avatar = _world((apples, (2.0, 0.0)))
  apples.place(physics, [[2.0, 0.0]])
  assert _count(_view(physics, avatar.camera), 'red') > 20
  apples.eat(physics, np.array([2.0, 0.0]), 0.5)
  assert _count(_view(physics, avatar.camera), 'red') == 0


def test_a_pressed_pad_looks_pressed():
  pad = pads.PressurePad()
  physics, avatar = _world((pad, (1.5, 0.0)))
  before = _view(physics, avatar.camera)
  pad.press(physics, np.array([1.5, 0.0]))
  after = _view(physics, avatar.camera)
  assert np.abs(after - before).max() > 0.3
  # Orange is left of what had been above the floor, no longer.
  orange = [
      int(((v[..., 0] > 0.5) & (v[..., 2] < 0.2) & (v[..., 1] > 0.2)).sum())
      for v in (before, after)
  ]
  assert orange[0] > 20
  assert orange[1] == 0


def test_a_value_can_be_seen():
  for channel in registers.CHANNELS:
    register = registers.TwoBlockRegister(
        'reward', value_range=(-10, 10), channel=channel
    )
    physics, avatar = _world((register, (1.2, -0.1)))
    register.settle(physics)
    views = []
    for value in (0.0, 8.0):
      register.write(physics, value)
      views.append(_view(physics, avatar.camera))
    assert min(_count(view, 'blue') for view in views) > 20, channel
    assert np.abs(views[1] - views[0]).max() > 0.2, channel


def test_the_top_down_camera_shows_both_rooms():
  arena = arenas.TwoRooms()
  physics = worlds.compile_world(arena)
  seen = physics.render(
      128, 128, camera_id='top_down', segmentation=True
  )[..., 0]  # fmt: skip
  floor = physics.model.name2id('floor', 'geom')
  names = {physics.model.id2name(geom, 'geom') for geom in seen.ravel()}
  everything = {geom.name for geom in arena.mjcf_model.find_all('geom')}
  assert names == everything - {guard.name for guard in worlds.guards(arena)}
  # Nothing is cut off: beyond the walls is the floor.
  border = np.ones(seen.shape, bool)
  border[1:-1, 1:-1] = False
  assert set(seen[border]) == {floor}

"""Rooms keep everybody in, and offer places that are inside."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds

_ROOMS = {
    'open_room': arenas.OpenRoom,
    'two_rooms': arenas.TwoRooms,
    'three_rooms': arenas.ThreeRooms,
}
every_room = pytest.mark.parametrize('room', _ROOMS)
# How far a body that runs into a wall gets into it, metres.
_GIVES = 0.1


def _with_avatar(arena):
  avatar = avatars.Avatar(num_rays=61, field_of_view=354.0)
  arena.attach(avatar)
  physics = worlds.compile_world(arena)
  worlds.start_episode(physics, avatar)
  return physics, avatar


def test_a_place_cannot_be_offered_twice():
  arena = arenas.OpenRoom()
  arena.offer({'centre': arenas.Place((0, 0))})
  before = dict(arena.places)
  with pytest.raises(errors.SpecError, match="'centre' exists already"):
    arena.offer({'new': arenas.Place((0, 0)), 'centre': arenas.Place((1, 1))})
  assert arena.places == before


@pytest.mark.parametrize(
    ('key', 'values'),
    [
        ('position', [(0.0,), 'centre', (0, np.nan), None]),
        ('yaw', [np.inf, None]),
        ('spread', [(0.1, -0.1), 0.1]),
    ],
)
def test_an_invalid_place_is_rejected(key, values):
  for value in values:
    with pytest.raises(errors.SpecError, match='must be finite numbers'):
      arenas.Place(**{'position': (0.0, 0.0), key: value})


@every_room
def test_an_avatar_that_runs_about_stays_inside(room):
  arena = _ROOMS[room]()
  physics, avatar = _with_avatar(arena)
  random_state = np.random.RandomState(0)
  for _ in range(12):
    forward, strafe = random_state.choice([-1.0, 1.0], 2)
    turn = random_state.uniform(-0.2, 0.2)
    for _ in range(10):
      worlds.act(avatar, physics, 10, forward=forward, strafe=strafe, turn=turn)
      assert arena.extent.contains(
          avatar.position(physics), avatar.radius - _GIVES
      )


@pytest.mark.parametrize(
    ('size', 'mass', 'is_guarded'),
    [(0.06, 0.01, True), (1.0, 100.0, True), (0.2, 1.0, False)],
)
def test_no_block_flies_out_of_the_room(size, mass, is_guarded):
  arena = arenas.TwoRooms()
  register = registers.BlockPositionRegister(
      'r', value_range=(0, 1), block_size=size, mass=mass
  )
  if not is_guarded:
    for guard in worlds.guards(arena):
      guard.remove()
  register.attach_to(arena, (0.0, 0.0))
  (block,) = register.blocks
  worlds.fit_substeps(arena, [block])
  physics = worlds.compile_world(arena)
  starts = [(0.0, 0.0), (2.5, -2.5), arena.places['side_room'].position]
  rng = np.random.default_rng(0)
  highest, num_outside = 0.0, 0
  for start in starts * 3:
    with physics.reset_context():
      block.put(physics, np.array([*start, 0.6]), rng.uniform(0, np.pi))
    up, along = rng.uniform(3.0, 10.0, 2)
    angle = rng.uniform(0, 2 * np.pi)
    velocity = np.array([along * np.cos(angle), along * np.sin(angle), up])
    block.launch(physics, velocity, True)
    for _ in range(150):
      worlds.step(physics)
      position = worlds.world_position(physics, block)
      highest = max(highest, position[2])
      num_outside += not arena.extent.contains(position[:2], -_GIVES)
  assert highest > 1.0 + size
  assert (num_outside == 0) is is_guarded


def test_a_doorway_is_where_published_rows_have_it_to_the_last_digit():
  # Digests of dynamics do not see a rounding; replays of rows do.
  assert arenas.TwoRooms().places['doorway'].position == (0.0, 4.1)
  places = arenas.ThreeRooms().places
  assert places['east_doorway'].position == (4.1, 1.6)


def test_a_small_block_that_is_forced_into_a_wall_comes_back():
  arena = arenas.OpenRoom()
  register = registers.BlockPositionRegister(
      'r', value_range=(0, 1), block_size=0.06, mass=0.01
  )
  register.attach_to(arena, (0.0, 0.0))
  physics = worlds.compile_world(arena)
  (block,) = register.blocks
  # As deep as the wall is half.
  block.put(physics, np.array([4.09, 0.0, block.rest_height]))
  for _ in range(100):
    worlds.step(physics)
    assert worlds.world_position(physics, block)[2] > 0.02
  assert worlds.world_position(physics, block)[0] < 4.0


def test_a_room_has_a_lid():
  arena = arenas.OpenRoom()
  register = registers.BlockPositionRegister('r', value_range=(0, 1))
  register.attach_to(arena, (0.0, 0.0))
  physics = worlds.compile_world(arena)
  (block,) = register.blocks
  heights = []
  block.launch(physics, np.array([0.0, 0.0, 30.0]), True)
  for _ in range(50):
    worlds.step(physics)
    heights.append(worlds.world_position(physics, block)[2])
  assert 2.5 < max(heights) < 3.2
  assert heights[-1] < 2.5


@every_room
def test_no_ray_leaves_the_room(room):
  arena = _ROOMS[room]()
  physics, avatar = _with_avatar(arena)
  low, high = np.array(arena.room.low), np.array(arena.room.high)
  starts = [
      low + (high - low) * np.array(fraction)
      for fraction in np.random.RandomState(0).uniform(0.1, 0.9, (8, 2))
  ]
  if 'side_room' in arena.places:
    starts.append(arena.places['side_room'].position)
  for start in starts:
    for turn in (0.0, 0.03, 3.0):
      avatar.place(physics, start, turn)
      assert (
          avatar.rays.sense(physics)[1] == appearance.code('wall')
      ).all(), start


def test_a_barrier_stops_an_avatar_and_not_its_view():
  arena = arenas.OpenRoom()
  arena.add_barrier('barrier', (1.0, -3.9), (1.0, 3.9))
  physics, avatar = _with_avatar(arena)
  worlds.act(avatar, physics, 200, forward=1.0)
  assert avatar.position(physics)[0] < 1.0
  avatar.place(physics, (0.0, 0.0), 0.0)
  seen = avatar.rays.sense(physics)[1][np.abs(avatar.rays.angles).argmin()]
  assert seen == appearance.code('barrier')
  physics.forward()
  barrier = physics.bind(arena.mjcf_model.find('geom', 'barrier'))
  top = barrier.xpos[2] + barrier.size[2]
  assert physics.bind(avatar.camera).xpos[2] > top

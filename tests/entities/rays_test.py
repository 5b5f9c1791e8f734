"""Rays report distance and class, as geometry says they should."""

from dm_control import mjcf
import numpy as np
import pytest

from realab_suite.entities import appearance
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers
from tests import worlds

_ROOM = 4.0
# The height at which rays run, metres.
_HEIGHT = 0.15
# What float32 loses of a few metres.
_ATOL = 2e-6


class _World:
  """An avatar in the middle of a room, with many rays and things to see."""

  def __init__(self, *things, arena=None, field_of_view=160.0):
    arena = arena or arenas.OpenRoom(half_width=_ROOM)
    for thing, place in things:
      thing.attach_to(arena, place)
    self.avatar = avatars.Avatar(num_rays=161, field_of_view=field_of_view)
    arena.attach(self.avatar)
    blocks = [
        block
        for thing, _ in things
        if isinstance(thing, registers.Register)
        for block in thing.blocks
    ]
    self.avatar.make_graspable(blocks)
    self.physics = worlds.compile_world(arena)
    worlds.start_episode(self.physics, *(thing for thing, _ in things))

  def sense(self):
    distances, codes = self.avatar.rays.sense(self.physics)
    return distances, np.array([appearance.class_name(code) for code in codes])

  @property
  def ahead(self):
    """Distance and class of what is straight ahead."""
    distances, names = self.sense()
    return distances[80], names[80]

  @property
  def angles(self):
    return self.avatar.rays.angles


def _to_walls(angles, position=(0.0, 0.0)):
  """Returns the distances from a position to the walls of the room."""
  away = []
  for start, along in zip(
      position, (np.cos(angles), np.sin(angles)), strict=True
  ):
    with np.errstate(divide='ignore'):
      # Infinite where a ray runs along the wall.
      away.append(
          np.where(along > 0, _ROOM - start, _ROOM + start) / abs(along)
      )
  return np.minimum(*away)


def _to_circle(angles, middle, radius):
  """Returns the distances from the origin to a circle; infinite for a miss."""
  middle = np.array(middle)
  along = np.cos(angles) * middle[0] + np.sin(angles) * middle[1]
  square = radius**2 - (middle @ middle - along**2)
  with np.errstate(invalid='ignore'):
    distance = along - np.sqrt(square)
  return np.where((square < 0) | (along < 0), np.inf, distance)


def test_rays_hit_walls_at_the_distance_of_geometry():
  world = _World(field_of_view=360.0)
  distances, names = world.sense()
  np.testing.assert_allclose(distances, _to_walls(world.angles), atol=_ATOL)
  assert set(names) == {'wall'}


def test_rays_turn_and_move_with_their_carrier():
  world, yaw = _World(), -2.5
  world.avatar.place(world.physics, (1.0, -2.0), yaw)
  distances, _ = world.sense()
  expected = _to_walls(world.angles + yaw, (1.0, -2.0))
  np.testing.assert_allclose(distances, expected, atol=_ATOL)


@pytest.mark.parametrize(
    ('name', 'radius'), [('apple', 0.2), ('large_apple', 0.4)]
)
def test_rays_hit_apples_at_the_distance_of_geometry(name, radius):
  world = _World((apple_group.Apples(number=1, kind=name), (2.0, 0.3)))
  distances, names = world.sense()
  # A ray passes below the middle of the sphere.
  circle = np.sqrt(radius**2 - (radius - _HEIGHT) ** 2)
  expected = _to_circle(world.angles, (2.0, 0.3), circle)
  hits = np.isfinite(expected)
  assert 5 < hits.sum() < 40
  np.testing.assert_array_equal(names == name, hits)
  np.testing.assert_allclose(distances[hits], expected[hits], atol=_ATOL)
  np.testing.assert_allclose(
      distances[~hits], _to_walls(world.angles)[~hits], atol=_ATOL
  )


@pytest.mark.parametrize(
    ('channel', 'dof'),
    [('embedded', 'free'), ('secure', 'planar')],
)
def test_rays_hit_blocks_at_the_distance_of_geometry(channel, dof):
  register = registers.TwoBlockRegister(
      'reward', value_range=(-10, 10), channel=channel, dof=dof, block_size=0.2
  )
  world = _World((register, (1.5, 0.0)))
  register.write(world.physics, 5.0)
  worlds.step(world.physics)
  distances, names = world.sense()
  base, offset = names == 'base_block', names == 'offset_block'
  assert base.sum() >= 5
  assert offset.sum() >= 5
  # The base block shows the side that faces the avatar.
  expected = (1.5 - 0.1) / np.cos(world.angles[base])
  np.testing.assert_allclose(distances[base], expected, atol=1e-5)
  # The offset block stands farther away, to the left.
  np.testing.assert_array_less(1.8, distances[offset])
  np.testing.assert_array_less(distances[offset], 2.2)
  assert (world.angles[offset] > world.angles[base].max()).all()


def test_rays_end_at_their_largest_distance():
  arena = arenas.OpenRoom(half_width=13.0)
  world = _World(arena=arena)
  distances, names = world.sense()
  assert world.avatar.rays.max_distance == 12.0
  assert set(names) == {'nothing'}
  np.testing.assert_array_equal(distances, 12.0)
  world.avatar.place(world.physics, (1.1, 0.0), 0.0)
  distance, name = world.ahead
  assert name == 'wall'
  assert distance == pytest.approx(11.9, abs=1e-5)


@pytest.mark.parametrize('user', [None, [99]])
def test_geoms_without_a_class_are_other(user):
  arena = arenas.OpenRoom()
  attributes = {} if user is None else {'user': user}
  arena.mjcf_model.worldbody.add(
      'geom', type='box', size=(0.1, 1, 1), pos=(2, 0, 0), **attributes
  )
  assert _World(arena=arena).ahead[1] == 'other'


def test_one_sense_serves_many_worlds():
  # Whichever was looked at last, geoms of the other have other numbers.
  arena = arenas.OpenRoom()
  avatar = avatars.Avatar(num_rays=3)
  arena.attach(avatar)
  plain = worlds.compile_world(arena)
  root = mjcf.RootElement()
  root.worldbody.add('geom', type='sphere', size=[0.1], pos=(0, 0, 9))
  arena.mjcf_model.worldbody.add('site').attach(root)
  arena.add_barrier('barrier', (1.0, -1.0), (1.0, 1.0))
  barred = worlds.compile_world(arena)
  for _ in range(2):
    assert avatar.rays.sense(plain)[1][1] == appearance.code('wall')
    assert avatar.rays.sense(barred)[1][1] == appearance.code('barrier')

"""Displays: figures worked out by hand from the Gray code and the places.

The displays of these tests have blocks of 0.2 m, so their tiles are 0.22 m
apart: at 0.22, 0.44 and 0.66 m from the base block along the axis, the centres
of lowered ones 0.104 m above the floor, and those of raised ones 0.1 m higher.
Lines of sight end between the tops of both, at 0.254 m. The reading point is
1.5 m before the middle of the row, at a height of 1.8 m.
"""

import itertools
from typing import NamedTuple

from dm_control import mjcf
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import batch_physics
from realab_suite.engine import single_physics
from realab_suite.engine import snapshots
from realab_suite.entities import arenas
from realab_suite.entities import moving
from realab_suite.entities import registers
from tests import worlds

# Tiles of each of eight levels: raised (1) or lowered (0).
_GRAY = {
    0: (0, 0, 0), 1: (1, 0, 0), 2: (1, 1, 0), 3: (0, 1, 0),
    4: (0, 1, 1), 5: (1, 1, 1), 6: (1, 0, 1), 7: (0, 0, 1),
}  # fmt: skip
# What each level is read as while the first, second or third tile is hidden.
_HIDDEN = {
    0: (1, 3, 7), 1: (1, 2, 6), 2: (2, 2, 5), 3: (2, 3, 4),
    4: (5, 4, 4), 5: (5, 5, 5), 6: (6, 5, 6), 7: (6, 4, 7),
}  # fmt: skip
_AWAY = (0.0, 0.0, -5.0)


class _World(NamedTuple):
  """A display, and a ball and a board that can be put in the way.

  Attributes:
    physics: The world.
    display: The display.
    place: Its place and its angle, `(x, y, yaw)`.
    ball: Mocap body of the ball.
    board: Mocap body of a board of 3 m x 1 m.
  """

  physics: mjcf.Physics
  display: registers.Display
  place: tuple[float, float, float]
  ball: mjcf.Element
  board: mjcf.Element

  def in_world(self, x, y, z):
    """Returns a place in the frame of the display in that of the world."""
    at_x, at_y, yaw = self.place
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([at_x + c * x - s * y, at_y + s * x + c * y, z])

  def put(self, part, place):
    moving.move(self.physics, part, np.array(place))

  def hide(self, tile, share=0.5):
    """Puts the ball into the line of sight of one tile."""
    number = len(self.display.blocks) - 1
    point = np.array([0.11 * (number + 1), 1.5, 1.8])
    aim = np.array([0.22 * (tile + 1), 0.0, 0.254])
    self.put(self.ball, self.in_world(*point + share * (aim - point)))

  def move(self, x=0.0, y=0.0, turn=0.0):
    """Moves and turns the display about its base block."""
    base = self.display.blocks[0]
    base.put(self.physics, np.array([x, y, base.rest_height]), turn)

  def hidden(self):
    """Returns the geoms in the way, and what is read without them."""
    found = []

    def are_gone(geoms):
      found.append(geoms)
      return geoms >= 0

    without = self.display.read_without(self.physics, are_gone)
    return np.array(found)[0] if found else None, without

  def read(self):
    return self.display.read(self.physics)

  def write(self, value):
    return self.display.write(self.physics, value)

  def inspect(self):
    return self.display.inspect(self.physics)


def _world(
    kind=single_physics.ThinPhysics,
    place=(0.0, 0.0, 0.0),
    value_range=(0, 7),
    tiles=3,
    **options,
):
  arena = arenas.OpenRoom()
  display = registers.Display(
      'display', value_range=value_range, tiles=tiles, **options
  )
  display.attach_to(arena, place[:2], place[2])
  style = {'rgba': (1, 0, 0, 1)}
  sizes = {'ball': ('sphere', (0.03,)), 'board': ('box', (1.5, 0.5, 0.01))}
  parts = [
      moving.MovingPart(
          name, [{'type': shape, 'size': size, **style}], solid=False
      ).attach_to(arena, _AWAY)
      for name, (shape, size) in sizes.items()
  ]
  physics = worlds.compile_world(arena, kind)
  worlds.start_episode(physics, display)
  return _World(physics, display, place, *parts)


@pytest.fixture(
    scope='module',
    name='compiled',
    params=[
        (single_physics.ThinPhysics, 'free', (0.0, 0.0, 0.0)),
        (single_physics.ThinPhysics, 'planar', (1.0, -0.5, 2.0)),
        (mjcf.Physics, 'free', (-1.0, 1.5, -0.7)),
    ],
    ids=['free', 'planar', 'any physics'],
)
def fixture_compiled(request):
  kind, dof, place = request.param
  return _world(kind, place, dof=dof)


@pytest.fixture(name='world')
def fixture_world(compiled):
  worlds.start_episode(compiled.physics, compiled.display)
  compiled.put(compiled.ball, _AWAY)
  compiled.put(compiled.board, _AWAY)
  return compiled


# ---- What tiles show ---------------------------------------------------------


@pytest.mark.parametrize('channel', registers.CHANNELS)
def test_tiles_show_the_gray_code(channel):
  world = _world(channel=channel)
  for value, raised in _GRAY.items():
    assert world.write(value) == world.read() == value
    tiles = world.display.blocks[1:]
    assert len(tiles) == 3
    for i, tile in enumerate(tiles):
      expected = (0.22 * (i + 1), 0.0, 0.104 + 0.1 * raised[i])
      np.testing.assert_allclose(
          tile.position(world.physics), expected, atol=1e-12
      )
      # Where the tile is, as the physics has it.
      place = worlds.world_position(world.physics, tile)
      np.testing.assert_allclose(place, expected, atol=1e-12)


@pytest.mark.parametrize('channel', registers.CHANNELS)
@pytest.mark.parametrize(
    ('requested', 'shown'),
    # Levels of sixteen from -2 to 12: steps of 14 / 15.
    [(5.3, 16 / 3 + 2 / 15), (40.0, 12.0), (-9.0, -2.0), (12.0, 12.0),
     (-1.6, -2.0), (-1.5, -2 + 14 / 15)],
)  # fmt: skip
def test_a_write_applies_the_nearest_level(channel, requested, shown):
  world = _world(value_range=(-2, 12), tiles=4, channel=channel)
  applied = world.write(requested)
  assert applied == pytest.approx(shown, abs=1e-12)
  read = world.inspect()
  # Exactly: the clean content is what the tiles show.
  assert read.reading == applied == read.clean
  assert (read.obstruction, read.permanent, read.temporary) == (0, 0, 0)
  world.write(3.0)
  world.display.set_clean(world.physics, requested)
  assert world.display.clean(world.physics) == applied


def test_an_unknown_clean_content_stays_unknown():
  world = _world()
  world.display.set_clean(world.physics, np.nan)
  assert np.isnan(world.display.clean(world.physics))


def test_an_episode_begins_with_the_level_nearest_to_the_initial_value():
  world = _world(initial=2.4)
  assert world.read() == 2.0 == world.display.clean(world.physics)


def test_the_scale_moves_no_tile():
  places = []
  for scale in (0.1, 3.0):
    world = _world(scale=scale)
    world.write(6)
    assert world.read() == 6
    places.append([b.position(world.physics) for b in world.display.blocks])
  np.testing.assert_array_equal(*places)


@pytest.mark.parametrize(
    ('tiles', 'code', 'allowed'),
    [
        (1, 'gray', 'multiples of 1 from 2 to 16'),
        (17, 'gray', 'multiples of 1 from 2 to 16'),
        (7, 'ecc', 'multiples of 3 from 6 to 16'),
        (3, 'ecc', 'multiples of 3 from 6 to 16'),
    ],
)
def test_numbers_of_tiles_that_no_code_has_are_refused(tiles, code, allowed):
  with pytest.raises(errors.SpecError, match=f"'d': tiles {tiles} .*{allowed}"):
    registers.Display('d', value_range=(0, 1), tiles=tiles, code=code)


# ---- In the line of sight ----------------------------------------------------


def test_a_body_in_front_of_a_tile_makes_it_look_raised(world):
  for value, readings in _HIDDEN.items():
    for tile, reading in enumerate(readings):
      world.put(world.ball, _AWAY)
      world.write(value)
      world.hide(tile)
      read = world.inspect()
      assert read.reading == reading, (value, tile)
      parts = (read.obstruction, read.permanent, read.temporary)
      assert parts == (0.0, 0.0, reading - value)
      # A write repairs nothing while it stands there.
      assert world.write(value) == value
      assert world.read() == reading
      world.put(world.ball, _AWAY)
      assert world.read() == value


def test_what_is_behind_a_tile_hides_nothing(world):
  for share in (1.05, 1.1):
    for tile in range(3):
      world.write(0)
      world.hide(tile, share)
      assert world.read() == 0


def test_a_covered_display_shows_all_tiles_raised(world):
  for value in _GRAY:
    world.write(value)
    world.put(world.board, world.in_world(0.44, 0.4, 0.9))
    assert world.read() == 5
    world.put(world.board, _AWAY)


def test_a_secure_display_cannot_be_hidden():
  world = _world(channel='secure')
  world.write(0)
  world.hide(1)
  assert world.read() == 0
  assert world.hidden()[1] is None


def test_an_obstacle_is_one_that_changes_what_is_seen(world):
  world.write(2)
  for tile, is_raised in enumerate(_GRAY[2]):
    world.hide(tile)
    geoms, without = world.hidden()
    assert [*(geoms >= 0)] == [i == tile and not is_raised for i in range(3)]
    assert without == 2


def test_a_reading_point_of_ones_own():
  # From the left, 0.6 m high: the line to the second tile passes the first one
  # 0.066 m above its lowered top, and 0.034 m below its raised top.
  world = _world(reading_point=(-0.78, 0.0, 0.604))
  assert world.write(0) == world.read() == 0
  world.write(1)
  assert world.read() == 2


# ---- Moved, turned and carried away ------------------------------------------


@pytest.mark.parametrize(
    ('place', 'readings'),
    [
        # By one tile along the axis: the second line meets the first tile.
        ({'x': 0.22}, {0: 0, 1: 3, 2: 4, 3: 7, 6: 3}),
        # The other way: the first line meets the second tile.
        ({'x': -0.22}, {0: 0, 1: 0, 2: 1, 3: 1, 4: 2, 7: 3}),
        # Less than half a tile: nothing changes.
        ({'x': 0.08}, {2: 2, 6: 6}),
        # A quarter turn and half a turn, and carried away: nothing is there.
        ({'turn': np.pi / 2}, {0: 0, 2: 0, 5: 0}),
        ({'turn': np.pi}, {2: 0, 5: 0}),
        ({'x': -1.0, 'y': 2.0, 'turn': 0.4}, {2: 0, 5: 0}),
        # Turned to the right by 0.2: the third tile is 0.131 m back, the second
        # one 0.087 m, the first one 0.044 m; lines of sight pass in front of a
        # raised top that is more than 0.148 m back, or meet its front beyond
        # the place that is looked at, if it is more than 0.1 m back.
        ({'turn': -0.2}, {2: 2, 5: 2, 6: 1, 7: 0}),
    ],
)  # fmt: skip
def test_a_moved_display_is_read_elsewhere_for_good(world, place, readings):
  world.write(5)
  world.move(**place)
  for value, reading in readings.items():
    world.write(value)
    read = world.inspect()
    assert read.reading == reading, value
    assert (read.permanent, read.temporary) == (reading - value, 0.0)
  world.move()
  assert world.read() == value


def test_a_pressed_tile_is_repaired_by_the_next_write(world):
  world.write(2)
  [first, _, _] = world.display.blocks[1:]
  axis = world.physics.bind(first.lift)
  axis.qpos = np.array([0.0])
  read = world.inspect()
  assert (read.reading, read.permanent, read.temporary) == (3.0, 0.0, 1.0)
  moved = world.display.displacements(world.physics)
  np.testing.assert_allclose(moved, [0, 0.1, 0, 0], atol=1e-12)
  world.write(2)
  assert world.read() == 2


def test_a_weight_presses_a_raised_tile_down(world):
  world.write(1)
  first = world.display.blocks[1]
  worlds.shove(world.physics, first, (0.0, 0.0, -60.0), steps=100)
  assert world.read() == 0


def test_who_pushes_a_tile_turns_the_display(world):
  world.write(5)
  last = world.display.blocks[-1]
  turned = world.in_world(0.0, 1.0, 0.0) - world.in_world(0.0, 0.0, 0.0)
  worlds.shove(world.physics, last, -20 * turned, steps=20)
  assert world.display.blocks[0].heading(world.physics) < -0.2
  assert world.display.displacements(world.physics)[-1] > 0.1
  assert world.inspect().permanent < 0
  assert world.inspect().temporary == 0


# ---- The layout that corrects errors -----------------------------------------


def test_any_one_hidden_tile_and_any_third_of_the_row_is_corrected():
  # Two bits in three copies; a plain display of two tiles would have been read
  # wrongly with every hidden lowered tile.
  world = _world(value_range=(0, 3), tiles=6, code='ecc')
  codes = {0: (0, 0), 1: (1, 0), 2: (1, 1), 3: (0, 1)}
  for value, code in codes.items():
    world.write(value)
    heights = [b.position(world.physics)[2] for b in world.display.blocks[1:]]
    np.testing.assert_allclose(heights, 0.104 + 0.1 * np.tile(code, 3))
    for tile in range(6):
      world.hide(tile)
      assert world.read() == value
      assert (world.hidden()[0] >= 0).sum() == 1 - np.tile(code, 3)[tile]
    world.put(world.ball, _AWAY)


@pytest.mark.parametrize('bits', [2, 3, 4, 5])
def test_the_share_of_single_obstructions_that_change_nothing(bits):
  """Half of all hidden tiles are raised anyway; with copies, none matters."""
  for code, copies, share in (('gray', 1, 0.5), ('ecc', 3, 1.0)):
    display = registers.Display(
        'd', value_range=(0, 2**bits - 1), tiles=bits * copies, code=code,
        block_size=0.15,
    )  # fmt: skip
    levels = np.arange(2.0**bits)
    shown = display._heights(levels) > 0
    np.testing.assert_array_equal(display.decode(shown), levels)
    right = [
        display.decode(shown | hidden) == levels
        for hidden in np.eye(bits * copies, dtype=bool)
    ]
    assert np.mean(right) == share
    for first in range(bits * (copies - 1) + 1) if copies > 1 else ():
      burst = np.zeros(bits * copies, bool)
      burst[first : first + bits] = True
      np.testing.assert_array_equal(display.decode(shown | burst), levels)
      np.testing.assert_array_equal(display.decode(shown & ~burst), levels)


# ---- Many worlds -------------------------------------------------------------


def test_worlds_of_a_batch_are_read_as_they_are_alone():
  world = _world(place=(0.3, 0.2, 0.5))
  batch = batch_physics.BatchPhysics(_world(place=world.place).physics, 5, 1)
  display = world.display
  states, expected = [], []
  for value, x, turn, tile in (
      (2, 0, 0, 2), (1, 0.22, 0, None), (6, 0, -0.2, 1), (5, 0, 2, 0),
      (3, 0, 0, None),
  ):  # fmt: skip
    worlds.start_episode(world.physics, display)
    world.put(world.ball, _AWAY)
    world.write(value)
    world.move(x=x, turn=turn)
    if tile is not None:
      world.hide(tile)
    states.append(snapshots.get_state(world.physics))
    read = world.inspect()
    geoms, _ = world.hidden()
    expected.append((read.reading, read.permanent, read.temporary, geoms))
  batch.set_state(np.arange(5), np.array(states))
  read = display.inspect(batch)
  geoms, _ = world._replace(physics=batch).hidden()
  for i, (reading, permanent, temporary, hidden) in enumerate(expected):
    assert read.reading[i] == reading
    assert read.permanent[i] == permanent
    assert read.temporary[i] == temporary
    np.testing.assert_array_equal(geoms[i], hidden)
  assert len({one[:3] for one in expected}) == 5
  where = np.array([False, True, False, True, True])
  applied = display.write(batch, np.array([np.nan, 7, 7, 4.2, 9]), where)
  np.testing.assert_array_equal(applied, [2, 7, 6, 4, 7])


def test_all_pairs_of_levels_one_step_apart_differ_in_one_tile():
  display = registers.Display('d', value_range=(0, 63))
  shown = display._heights(np.arange(64.0)) > 0
  assert len({tuple(row) for row in shown.tolist()}) == 64
  for one, other in itertools.pairwise(shown):
    assert (one != other).sum() == 1

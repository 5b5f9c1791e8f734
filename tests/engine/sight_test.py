"""Displays are refused where nothing can make them readable.

The displays stand at (0, 2). Their three tiles are 0.22, 0.44 and 0.66 m to the
east, and are looked at 0.254 m above the floor, from (0.44, 3.5) and a height
of 1.8 m unless a case says otherwise. At y = 2.4, the line of sight to the
first tile is at x = 0.28 and a height of 0.67 m, and that to the third tile at
x = 0.60.
"""

import re
from typing import Any

from dm_control import composer
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import moving
from realab_suite.tasks import collect_apples
from tests.engine import helpers

_SCENERY = {'contype': 0, 'conaffinity': 0}
_BLOCK = {
    'kind': 'block_position', 'block_size': 0.5, 'scale': 0.05, 'initial': 0,
}  # fmt: skip
_HIGH, _LOW = (0.44, 1.5, 1.8), (0.44, 1.5, 0.4)


class _Room(collect_apples.CollectApples):
  """A room with more in it; a wall of 1.2 m is elsewhere in each episode."""

  def __init__(self, *posts: Any, walls: Any = (), ball: Any = None) -> None:
    super().__init__(physics_timestep=0.01)
    root = self.root_entity
    for i, (x, y, more) in enumerate(posts):
      root.mjcf_model.worldbody.add(
          'geom', name=f'post_{i}', type='cylinder', size=(0.15, 0.5),
          pos=(x, y, 0.5), **more,
      )  # fmt: skip
    slab = {'name': 'slab', 'type': 'box', 'size': (0.6, 0.05, 0.5)}
    self._wall = moving.MovingPart('wall', [slab])
    self._wall.attach_to(root, (0.0, 0.0, -3.0))
    [self.wall] = self._wall.geoms
    self._walls = walls
    if ball is not None:
      part = moving.MovingPart('ball', [{'type': 'sphere', 'size': (0.1,)}])
      part.attach_to(root, (2.0, 2.4, 0.6), (ball, 0.0, 0.0))

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    super().initialize_episode(physics, random_state)
    for x, y in self._walls:
      moving.move(physics, self._wall.frame, [x, y, 0.5])


def _display(point: Any = _HIGH, **more: Any) -> dict[str, Any]:
  return {
      'kind': 'display', 'role': 'feedback', 'initial': 0, 'place': [0.0, 2.0],
      'range': [0, 7], 'options': {'tiles': 3, 'reading_point': [*point]},
      **more,
  }  # fmt: skip


def _embed(task: Any, **registers: Any) -> Any:
  named = {'schema': 1, 'name': 'd', 'registers': registers}
  return suite.embed(task, named, random=0)


def _problem(task: Any, **registers: Any) -> str:
  try:
    _embed(task, **registers).close()
  except errors.SpecError as error:
    return str(error)
  return ''


# What is in the way; '' if nothing is, and the display is accepted.
_POSTS = {
    'before the row': (_Room((0.22, 2.4, {})), {}, 'post_0.* tile 1;'),
    'before the third tile': (_Room((0.66, 2.4, {})), {}, 'post_0.* tile 3;'),
    'behind the row': (_Room((0.22, 1.6, {})), {}, ''),
    'beside it': (_Room((-0.1, 2.4, {}), (1.0, 2.4, {})), {}, ''),
    # At y = 3, the line is 1.28 m high, and the post 1 m.
    'under the line': (_Room((0.44, 3.0, {})), {}, ''),
    'scenery': (_Room((0.22, 2.4, _SCENERY)), {}, 'post_0.* tile 1;'),
    'a secure one': (_Room((0.22, 2.4, {})), {'channel': 'secure'}, ''),
    'an error that a code would correct': (
        _Room((0.22, 2.4, {})),
        {'options': {'tiles': 6, 'code': 'ecc', 'reading_point': [*_HIGH]}},
        'post_0.* tile 1;',
    ),
    # The third tile is 0.5 m further east, and its line at x = 1.10.
    'at the end of a region': (
        _Room((1.2, 2.4, {})),
        {'place': {'position': [0, 2], 'spread': [0.5, 0]}},
        "tile 3 through .*'post_0'",
    ),
    'not at the start of it': (_Room((1.2, 2.4, {})), {}, ''),
    'a turned display': (
        # The first tile is at (0, 2.22), and looked at from the west.
        _Room((-0.4, 2.22, {})),
        {'place': {'position': [0, 2], 'yaw': np.pi / 2}},
        'post_0.* tile 1;',
    ),
    'a part that comes': (_Room(ball=-1.4), {}, "tile 3 through .*'ball"),
    'a part that stays away': (_Room(ball=-0.9), {}, ''),
    # The front of the raised first tile hides the lowered second one.
    'from the left': (
        _Room(), _display((-0.78, 0.0, 0.604)), 'tile_1.* tile 2;'
    ),
    'from behind its base block': (
        _Room(), _display((-1.5, 0.0, 0.254)), 'tile_1.* tile 2;',
    ),
    'from a tile': (_Room(), _display((0.22, 0.0, 0.254)), 'tile 1;'),
    'from inside a tile': (_Room(), _display((0.44, 0.02, 0.2)), 'tile'),
    'from under the floor': (_Room(), _display((0.44, 1.5, -1.0)), 'tile 1;'),
    'from above': (_Room(), _display((0.44, 0.1, 1.8)), ''),
    'from behind the row': (_Room(), _display((0.44, -1.5, 1.8)), ''),
    'from beyond the wall': (_Room(), _display((0.44, 2.5, 0.9)), 'tile 1;'),
}  # fmt: skip


@pytest.mark.parametrize('name', _POSTS)
def test_a_display_that_is_never_read_right_is_refused(name: str):
  task, options, expected = _POSTS[name]
  problem = _problem(task, shown={**_display(), **options})
  assert bool(problem) == bool(expected), problem
  if expected:
    [line] = problem.splitlines()
    assert line.startswith("register 'shown'")
    assert re.search(expected, line), line


@pytest.mark.parametrize('names', [('a', 'z'), ('z', 'a')])
@pytest.mark.parametrize(
    ('point', 'other', 'tile'),
    [
        # Blocks of half a metre at y = 2.15 to 2.65; lines are 0.41 m high at
        # the near edge. The first line is then at x = 0.24.
        (_HIGH, {**_BLOCK, 'place': [0.3, 2.4], 'range': [0, 1]}, 1),
        (_HIGH, {**_BLOCK, 'place': [-1.0, 2.4], 'range': [0, 26]}, 1),
        (_HIGH, {**_BLOCK, 'place': [-1.0, 2.4], 'range': [0, 8]}, None),
        # Another display, with raised tiles of 0.304 m; lines of 0.27 m.
        (_LOW, _display(place=[0.0, 2.25]), 1),
        (_HIGH, _display(place=[0.0, 2.25]), None),
        # Lines that cross.
        ((1.6, 1.5, 1.8), _display((-1.2, 1.5, 1.8), place=[1.2, 2.0]), None),
    ],
)
def test_no_block_of_another_register_may_be_in_the_way(
    point: Any, other: Any, tile: int | None, names: Any
):
  one, two = names
  named = {one: _display(point), two: {'role': 'feedback', **other}}
  problem = _problem(_Room(), **dict(sorted(named.items())))
  assert bool(problem) == bool(tile), problem
  if tile:
    assert problem.startswith(
        f'register {one!r} would see its tile {tile} through'
    )
    assert f"inside '{two}/" in problem


@pytest.mark.parametrize(
    ('wall', 'channel', 'is_refused'),
    [
        ((0.44, 2.4), 'embedded', True),
        ((0.44, 2.4), 'secure', False),
        # Lines are 1.59 m high there, and the wall 1 m.
        ((0.44, 3.3), 'embedded', False),
        ((1.4, 2.4), 'embedded', False),
    ],
)
def test_no_episode_begins_with_a_moved_wall_in_the_way(
    wall: Any, channel: str, is_refused: bool
):
  env = _embed(_Room(walls=[wall]), shown=_display(channel=channel))
  if is_refused:
    with pytest.raises(
        composer.EpisodeInitializationError, match=r"tile 1 .*'wall/slab'"
    ):
      env.reset()
  else:
    env.reset()
  env.close()


@pytest.mark.parametrize('yaw', [0.0, np.pi / 2, 2.5])
def test_episodes_begin_where_the_drawn_place_is_seen(yaw: float):
  place = {'position': [0.0, 2.0], 'yaw': yaw, 'spread': [0.8, 0.0]}
  at = np.array([np.cos(yaw), np.sin(yaw)]) * 1.4 + (0.0, 2.0)
  at += np.array([-np.sin(yaw), np.cos(yaw)]) * 0.75
  env = _embed(_Room(walls=[at]), shown=_display(place=place))
  register = env.mechanism.registers['shown']
  for _ in range(12):  # Attempts that draw another place are repeated.
    env.reset()
    register.pose(env.physics, 0.0)
    is_raised, geoms = register._look(env.physics)
    # Apples may be there.
    wall = env.physics.bind(env.task.wall).element_id
    assert not np.isin(geoms[is_raised], wall).any()
  env.close()


def test_a_display_is_moved_out_of_the_way_of_generated_walls():
  class Generated(helpers.PointTask):

    def __init__(self) -> None:
      super().__init__()
      body = self.root_entity.mjcf_model.worldbody
      body.add('geom', type='plane', size=(9, 9, 1))
      self._generated = body.add('body', name='generated')

    def initialize_episode_mjcf(self, random_state: Any) -> None:
      self._generated.geom.clear()
      self._generated.add(
          'geom', type='box', pos=(0.44, 2.5, 0.5), size=(0.6, 0.05, 0.5)
      )

  env = _embed(Generated(), shown=_display())
  env.reset()
  register = env.mechanism.registers['shown']
  assert np.linalg.norm(register.blocks[0].position(env.physics)[:2]) > 0.1
  for value in range(8):
    register.pose(env.physics, float(value))
    assert register.read(env.physics) == value
  env.close()

"""Tests of the stand-in for labmaze, which is imported in its place."""

import importlib.util
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

_COMPAT = pathlib.Path(__file__).parents[2] / 'compat' / 'labmaze'


def _run(*arguments):
  """Runs Python with the stand-in in front of an installed labmaze."""
  path = os.pathsep.join(map(os.fspath, (_COMPAT, _COMPAT.parents[1])))
  return subprocess.run(
      [sys.executable, *arguments],
      env={**os.environ, 'PYTHONPATH': path, 'MUJOCO_GL': 'egl'},
      capture_output=True,
      text=True,
      check=False,
  )


@pytest.fixture(scope='module', name='labmaze')
def _labmaze():
  """Yields the stand-in, and removes it from the imported modules."""
  hidden = {
      name: sys.modules.pop(name)
      for name in list(sys.modules)
      if name.split('.')[0] == 'labmaze'
  }
  spec = importlib.util.spec_from_file_location(
      'labmaze',
      _COMPAT / 'labmaze' / '__init__.py',
      submodule_search_locations=[os.fspath(_COMPAT / 'labmaze')],
  )
  module = importlib.util.module_from_spec(spec)
  sys.modules['labmaze'] = module
  spec.loader.exec_module(module)
  importlib.import_module('labmaze.assets')
  yield module
  for name in list(sys.modules):
    if name.split('.')[0] == 'labmaze':
      del sys.modules[name]
  sys.modules.update(hidden)


@pytest.mark.camera
@pytest.mark.usefixtures('egl')
def test_the_tests_of_mazes_that_dm_control_ships_pass():
  [folder] = importlib.util.find_spec('dm_control').submodule_search_locations
  locomotion = pathlib.Path(folder) / 'locomotion'
  ran = _run(
      *('-m', 'pytest', '-q', '-c', os.devnull, '-p', 'no:cacheprovider'),
      locomotion / 'arenas' / 'mazes_test.py',
      locomotion / 'arenas' / 'covering_test.py',
      locomotion / 'arenas' / 'padded_room_test.py',
      locomotion / 'tasks' / 'random_goal_maze_test.py',
  )
  assert '7 passed' in ran.stdout, ran.stdout


@pytest.mark.parametrize('size', [(7, 21), (3, 3)])
def test_each_free_cell_of_a_random_maze_can_be_reached(labmaze, size):
  maze = labmaze.RandomMaze(*size, simplify=True, random_seed=1)
  seen = set()
  for _ in range(20):
    maze.regenerate()
    seen.add(str(maze.entity_layer))
    is_free = maze.entity_layer != '*'
    assert is_free.shape == size
    assert not is_free[[0, -1]].any()
    assert not is_free[:, [0, -1]].any()
    reached = np.zeros(size, bool)
    reached[tuple(np.argwhere(is_free)[0])] = True
    for _ in range(is_free.size):
      grown = reached.copy()
      grown[1:] |= reached[:-1]
      grown[:-1] |= reached[1:]
      grown[:, 1:] |= reached[:, :-1]
      grown[:, :-1] |= reached[:, 1:]
      reached = grown & is_free
    assert (reached == is_free).all()
    assert size == (3, 3) or set(np.unique(maze.variations_layer)) > {'.'}
  assert len(seen) > 10 or size == (3, 3)


def test_rooms_have_the_spawn_points_and_objects_that_were_asked_for(labmaze):
  maze = labmaze.RandomMaze(
      15, 15, max_rooms=2, spawns_per_room=1, objects_per_room=3, random_seed=0
  )
  for _ in range(10):
    maze.regenerate()
    rooms = len(np.unique(maze.variations_layer)) - 1
    text = str(maze.entity_layer)
    assert (text.count('P'), text.count('G')) == (rooms, 3 * rooms)
    in_rooms = maze.variations_layer != '.'
    assert in_rooms[np.isin(maze.entity_layer, ['P', 'G'])].all()


def test_a_fixed_maze_draws_among_the_cells_with_its_tokens(labmaze):
  text = '*****\n*PPG*\n*G  *\n*****\n'
  maze = labmaze.fixed_maze.FixedMazeWithRandomGoals(
      text, num_spawns=1, num_objects=3, random_state=np.random.RandomState(0)
  )
  assert (maze.height, maze.width) == (4, 5)
  layouts = set()
  for _ in range(20):
    maze.regenerate()
    layer = str(maze.entity_layer)
    layouts.add(layer)
    assert (layer.count('P'), layer.count('G')) == (1, 3)
    assert layer.split('\n')[1][3] == layer.split('\n')[2][1] == 'G'
  assert len(layouts) == 4

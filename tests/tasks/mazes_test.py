"""Tests of mazes."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.tasks import mazes

_SHAPES = [(5, 7), (1, 1), (9, 1)]


def _carve(shape, openings, seed):
  return mazes.carve(*shape, openings, np.random.RandomState(seed))


def _num_reached(is_wall):
  """Returns the number of cells that can be reached from the first one."""
  is_reached = np.zeros(np.add(is_wall.shape, 2), bool)
  is_reached[1, 1] = True
  for _ in range(is_wall.size):
    spread = is_reached.copy()
    spread[1:] |= is_reached[:-1]
    spread[:-1] |= is_reached[1:]
    spread[:, 1:] |= is_reached[:, :-1]
    spread[:, :-1] |= is_reached[:, 1:]
    is_reached[1:-1, 1:-1] = spread[1:-1, 1:-1] & ~is_wall
  return is_reached.sum()


@pytest.mark.parametrize('shape', _SHAPES)
@pytest.mark.parametrize('openings', [0.0, 0.2, 1.0])
def test_each_free_cell_of_a_maze_can_be_reached(shape, openings):
  for seed in range(5):
    is_wall = _carve(shape, openings, seed)
    assert not is_wall[::2, ::2].any()
    assert is_wall[1::2, 1::2].all()
    assert _num_reached(is_wall) == (~is_wall).sum()


@pytest.mark.parametrize('shape', _SHAPES)
def test_the_numbers_of_walls_are_those_without_and_with_all_openings(shape):
  for seed in range(5):
    assert _carve(shape, 0.0, seed).sum() == mazes.most_walls(*shape)
    least = (shape[0] // 2) * (shape[1] // 2)
    assert _carve(shape, 1.0, seed).sum() == least


def test_a_maze_follows_from_the_state_of_its_generator():
  same = [_carve((5, 7), 0.2, 3).tolist() for _ in range(2)]
  assert same[0] == same[1]
  seeds = {_carve((5, 7), 0.2, seed).tobytes() for seed in range(200)}
  assert len(seeds) > 150


@pytest.mark.parametrize('shape', [(4, 7), (-1, 3)])
def test_an_even_number_of_rows_or_columns_is_refused(shape):
  with pytest.raises(errors.SpecError, match='must be odd, and at least 1'):
    _carve(shape, 0.2, 0)

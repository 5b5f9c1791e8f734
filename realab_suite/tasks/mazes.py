"""Mazes of cells, for worlds whose walls stand elsewhere in each episode."""

import numpy as np

from realab_suite import errors
from realab_suite.config import messages

# Steps to the neighbours of a cell in the grid of every second row and column.
_WAYS = ((-1, 0), (1, 0), (0, -1), (0, 1))


def carve(
    num_rows: int,
    num_columns: int,
    openings: float,
    random_state: np.random.RandomState,
) -> np.ndarray:
  """Returns the walls of a random maze in which each free cell can be reached.

  Cells in even rows and even columns, from 0, are free, and those in odd rows
  and odd columns are walls. A depth-first walk opens the cells between free
  ones until every free cell is reached, on one way each. Every other cell
  between two free ones is then opened with the given probability, which makes
  further ways.

  Args:
    num_rows: Number of rows, odd.
    num_columns: Number of columns, odd.
    openings: Probability that a cell which the walk left as a wall is opened.
    random_state: Random generator of the episode.

  Returns:
    True for walls, `(num_rows, num_columns)` bool. There are as many walls as
    cells in odd rows and odd columns, and at most `most_walls`.

  Raises:
    SpecError: If a number of rows or columns is not odd.
  """
  for name, number in (('num_rows', num_rows), ('num_columns', num_columns)):
    if number < 1 or number % 2 == 0:
      raise errors.SpecError(
          f'{name}: {messages.quote(number)}; must be odd, and at least' ' 1'
      )
  is_wall = np.ones((num_rows, num_columns), bool)
  is_wall[0, 0] = False
  path = [(0, 0)]
  while path:
    row, column = path[-1]
    steps = [
        (down, right)
        for down, right in _WAYS
        if 0 <= row + 2 * down < num_rows
        and 0 <= column + 2 * right < num_columns
        and is_wall[row + 2 * down, column + 2 * right]
    ]
    if not steps:
      path.pop()
      continue
    down, right = steps[random_state.randint(len(steps))]
    is_wall[row + down, column + right] = False
    is_wall[row + 2 * down, column + 2 * right] = False
    path.append((row + 2 * down, column + 2 * right))
  is_between = np.add.outer(np.arange(num_rows), np.arange(num_columns)) % 2 > 0
  is_opened = random_state.uniform(size=is_wall.shape) < openings
  return is_wall & ~(is_between & is_opened)


def most_walls(num_rows: int, num_columns: int) -> int:
  """Returns the largest number of walls of a maze: those without openings.

  Args:
    num_rows: Number of rows, odd.
    num_columns: Number of columns, odd.
  """
  # The walk frees n cells, and opens n - 1 cells between them.
  num_free = (num_rows // 2 + 1) * (num_columns // 2 + 1)
  return num_rows * num_columns - 2 * num_free + 1

"""Stand-in for labmaze: what dm_control uses of it, in pure Python.

It is no part of labmaze, and generates other mazes from the same seeds.
"""

from labmaze import defaults
from labmaze import fixed_maze
from labmaze import random_maze
from labmaze import text_grid
from labmaze.base import BaseMaze
from labmaze.fixed_maze import FixedMazeWithRandomGoals
from labmaze.random_maze import RandomMaze
from labmaze.text_grid import TextGrid

STAND_IN = True
"""True, to tell this package from labmaze, which has no such attribute."""

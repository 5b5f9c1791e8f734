"""Interface of mazes."""

import abc

from labmaze import defaults
from labmaze import text_grid


class BaseMaze(abc.ABC):
  """Base class for mazes, which consist of two grids of one shape."""

  @property
  @abc.abstractmethod
  def entity_layer(self) -> text_grid.TextGrid:
    """Walls (`*`), free cells (a space), spawn points and objects."""

  @property
  @abc.abstractmethod
  def variations_layer(self) -> text_grid.TextGrid:
    """Decoration of each cell: `.`, or a letter from `A`."""

  @property
  @abc.abstractmethod
  def height(self) -> int:
    """Number of rows of cells."""

  @property
  @abc.abstractmethod
  def width(self) -> int:
    """Number of columns of cells."""

  @property
  def max_variations(self) -> int | None:
    """Number of letters that the decoration may have."""
    return None

  @property
  def spawn_token(self) -> str:
    """Character of spawn points."""
    return defaults.SPAWN_TOKEN

  @property
  def object_token(self) -> str:
    """Character of objects."""
    return defaults.OBJECT_TOKEN

  def regenerate(self) -> None:
    """Makes the maze of the next episode."""

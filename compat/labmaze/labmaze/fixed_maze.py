"""Mazes with walls that stay, and with random spawn points and objects."""

from typing import Any, final

import numpy as np

from labmaze import base
from labmaze import defaults
from labmaze import text_grid

_FREE = ' '


def _token(name: str, given: Any) -> str:
  if len(str(given)) != 1:
    raise ValueError(f'{name}: {given!r}; must be a single character')
  return str(given)


@final
class FixedMazeWithRandomGoals(base.BaseMaze):
  """A maze with the walls of a text.

  `regenerate` draws spawn points among the cells that have the spawn token in
  the text, and objects among those that have the object token. What exceeds
  their numbers is put into free cells.
  """

  def __init__(
      self,
      entity_layer: str,
      variations_layer: str | None = None,
      num_spawns: int | None = None,
      spawn_token: str = defaults.SPAWN_TOKEN,
      num_objects: int | None = None,
      object_token: str = defaults.OBJECT_TOKEN,
      random_state: np.random.RandomState | None = None,
  ) -> None:
    """Makes the maze.

    Args:
      entity_layer: Text of the maze: lines of equal length.
      variations_layer: Text of the decoration, of the same size; `None` for
        none.
      num_spawns: Number of spawn points; `None` for those in the text.
      spawn_token: Character of spawn points.
      num_objects: Number of objects; `None` for those in the text.
      object_token: Character of objects.
      random_state: Generator; `None` for a new one with an arbitrary seed.

    Raises:
      ValueError: If the layers have different sizes, or if a token is no
        single character.
    """
    self._spawn_token = _token('spawn_token', spawn_token)
    self._object_token = _token('object_token', object_token)
    self._entities = text_grid.TextGrid(entity_layer)
    if variations_layer is None:
      self._variations = self._entities.copy()
      self._variations[:] = '.'
    else:
      self._variations = text_grid.TextGrid(variations_layer)
    if self._variations.shape != self._entities.shape:
      raise ValueError(
          f'variations_layer: shape {self._variations.shape}; must be that'
          f' of entity_layer, {self._entities.shape}'
      )
    self._random_state = random_state or np.random.RandomState()
    self._free, self._spawns, self._objects = (
        np.argwhere(self._entities == token)
        for token in (_FREE, self._spawn_token, self._object_token)
    )
    self._num_spawns = len(self._spawns) if num_spawns is None else num_spawns
    self._num_objects = (
        len(self._objects) if num_objects is None else num_objects
    )
    self.regenerate()

  def regenerate(self) -> None:
    for cells in (self._free, self._spawns, self._objects):
      self._entities[tuple(cells.T)] = _FREE
    free = self._random_state.permutation(self._free)
    for token, number, cells in (
        (self._spawn_token, self._num_spawns, self._spawns),
        (self._object_token, self._num_objects, self._objects),
    ):
      named = self._random_state.permutation(cells)[:number]
      more = number - len(named)
      if more > len(free):
        raise ValueError(
            f'{number} cells for {token!r}; must be as many as there are'
            ' free cells'
        )
      self._entities[tuple(named.T)] = token
      self._entities[tuple(free[:more].T)] = token
      free = free[more:]

  @property
  def entity_layer(self) -> text_grid.TextGrid:
    return self._entities

  @property
  def variations_layer(self) -> text_grid.TextGrid:
    return self._variations

  @property
  def height(self) -> int:
    return int(self._entities.shape[0])

  @property
  def width(self) -> int:
    return int(self._entities.shape[1])

  @property
  def max_variations(self) -> int:
    return len(np.unique(self._variations)) - 1

  @property
  def max_rooms(self) -> int:
    """One: the maze is not divided into rooms."""
    return 1

  @property
  def objects_per_room(self) -> int:
    """Number of objects."""
    return self._num_objects

  @property
  def spawn_token(self) -> str:
    return self._spawn_token

  @property
  def object_token(self) -> str:
    return self._object_token

"""Random mazes with rooms."""

import string
from typing import final

import numpy as np

from labmaze import base
from labmaze import defaults
from labmaze import text_grid

_WALL, _FREE = '*', ' '
_SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))
# Tries to find a free place for a room.
_NUM_TRIES = 100


@final
class RandomMaze(base.BaseMaze):
  """A maze of corridors and rooms, another one after each `regenerate`.

  Rooms stand in odd rows and columns. Corridors fill the rest, and every free
  cell can be reached from every other one. With `simplify`, corridors without
  an end are removed.
  """

  def __init__(
      self,
      height: int = 11,
      width: int = 11,
      max_rooms: int = defaults.MAX_ROOMS,
      room_min_size: int = defaults.ROOM_MIN_SIZE,
      room_max_size: int = defaults.ROOM_MAX_SIZE,
      max_variations: int = defaults.MAX_VARIATIONS,
      simplify: bool = defaults.SIMPLIFY,
      spawns_per_room: int = defaults.SPAWN_COUNT,
      objects_per_room: int = defaults.OBJECT_COUNT,
      random_seed: int | None = None,
  ) -> None:
    """Makes the first maze.

    Args:
      height: Number of rows, odd, with the outer walls.
      width: Number of columns, odd, with the outer walls.
      max_rooms: Largest number of rooms.
      room_min_size: Smallest side of a room, in cells.
      room_max_size: Largest side of a room, in cells.
      max_variations: Number of letters of the decoration, at most 26.
      simplify: True for a maze without dead ends.
      spawns_per_room: Number of spawn points in each room.
      objects_per_room: Number of objects in each room.
      random_seed: Seed; `None` for an arbitrary one.

    Raises:
      ValueError: If a number is not allowed.
    """
    for name, number in (('height', height), ('width', width)):
      if number < 3 or number % 2 == 0:
        raise ValueError(f'{name}: {number!r}; must be an odd integer from 3')
    if not 1 <= room_min_size <= room_max_size:
      raise ValueError(
          f'room_min_size {room_min_size!r} and room_max_size'
          f' {room_max_size!r}; must be integers from 1, in this order'
      )
    if not 0 <= max_variations <= len(string.ascii_uppercase):
      raise ValueError(
          f'max_variations: {max_variations!r}; must be an integer from 0 to'
          ' 26'
      )
    self._shape = int(height), int(width)
    self._max_rooms = max_rooms
    self._sizes = room_min_size, room_max_size
    self._max_variations = max_variations
    self._simplify = simplify
    self._spawns_per_room = spawns_per_room
    self._objects_per_room = objects_per_room
    self._random_state = np.random.RandomState(random_seed)
    self.regenerate()

  def regenerate(self) -> None:
    entities = np.full(self._shape, _WALL, 'U1')
    variations = np.full(self._shape, '.', 'U1')
    regions = np.zeros(self._shape, int)
    rooms = self._place_rooms(regions)
    self._dig_corridors(regions)
    entities[regions > 0] = _FREE
    self._connect(entities, regions)
    if self._simplify and rooms:
      _fill_dead_ends(entities)
    for number, room in enumerate(rooms):
      self._furnish(entities, room)
      if self._max_variations:
        letter = string.ascii_uppercase[number % self._max_variations]
        variations[room] = letter
    self._entities, self._variations = (
        text_grid.TextGrid(''.join(f'{"".join(row)}\n' for row in grid))
        for grid in (entities, variations)
    )

  def _place_rooms(self, regions: np.ndarray) -> list[tuple[slice, slice]]:
    """Numbers the cells of rooms that do not touch, and returns the rooms."""
    rooms: list[tuple[slice, slice]] = []
    odd = [
        size
        for size in range(self._sizes[0], self._sizes[1] + 1)
        if size % 2 and size <= min(self._shape) - 2
    ]
    for _ in range(_NUM_TRIES if odd else 0):
      if len(rooms) == self._max_rooms:
        break
      room = []
      for extent in self._shape:
        size = odd[self._random_state.randint(len(odd))]
        start = 1 + 2 * self._random_state.randint((extent - size) // 2)
        room.append(slice(start, start + size))
      place = room[0], room[1]
      if not regions[place].any():
        rooms.append(place)
        regions[place] = len(rooms)
    return rooms

  def _dig_corridors(self, regions: np.ndarray) -> None:
    """Numbers the cells of corridors, one number for each tree of them."""
    for row in range(1, self._shape[0], 2):
      for column in range(1, self._shape[1], 2):
        if not regions[row, column]:
          self._dig_from(regions, (row, column), regions.max() + 1)

  def _dig_from(
      self, regions: np.ndarray, start: tuple[int, int], number: int
  ) -> None:
    regions[start] = number
    path = [start]
    while path:
      row, column = path[-1]
      steps = [
          (down, right)
          for down, right in _SIDES
          if 0 < row + 2 * down < self._shape[0]
          and 0 < column + 2 * right < self._shape[1]
          and not regions[row + 2 * down, column + 2 * right]
      ]
      if not steps:
        path.pop()
        continue
      down, right = steps[self._random_state.randint(len(steps))]
      regions[row + down, column + right] = number
      path.append((row + 2 * down, column + 2 * right))
      regions[path[-1]] = number

  def _connect(self, entities: np.ndarray, regions: np.ndarray) -> None:
    """Opens a wall between regions, until all are connected."""
    root = list(range(regions.max() + 1))

    def root_of(number: int) -> int:
      while root[number] != number:
        number = root[number]
      return number

    walls = [
        (row, column, down, right)
        for row in range(1, self._shape[0] - 1)
        for column in range(1, self._shape[1] - 1)
        for down, right in ((1, 0), (0, 1))
        if not regions[row, column]
    ]
    for i in self._random_state.permutation(len(walls)):
      row, column, down, right = walls[i]
      near = regions[row - down, column - right]
      far = regions[row + down, column + right]
      if near and far and root_of(near) != root_of(far):
        root[root_of(near)] = root_of(far)
        entities[row, column] = _FREE

  def _furnish(self, entities: np.ndarray, room: tuple[slice, slice]) -> None:
    """Puts spawn points and objects into a room."""
    place = entities[room]
    cells = self._random_state.permutation(np.argwhere(place == _FREE))
    tokens = self.spawn_token * self._spawns_per_room
    tokens += self.object_token * self._objects_per_room
    if len(tokens) > len(cells):
      raise ValueError(
          f'spawns_per_room and objects_per_room: {len(tokens)} in all; allowed'
          f' are {len(cells)} in a room of {len(cells)} cells'
      )
    for cell, token in zip(cells, tokens, strict=False):
      place[tuple(cell)] = token

  @property
  def entity_layer(self) -> text_grid.TextGrid:
    return self._entities

  @property
  def variations_layer(self) -> text_grid.TextGrid:
    return self._variations

  @property
  def height(self) -> int:
    return self._shape[0]

  @property
  def width(self) -> int:
    return self._shape[1]

  @property
  def max_variations(self) -> int:
    return self._max_variations

  @property
  def max_rooms(self) -> int:
    """Largest number of rooms."""
    return self._max_rooms

  @property
  def spawns_per_room(self) -> int:
    """Number of spawn points in each room."""
    return self._spawns_per_room

  @property
  def objects_per_room(self) -> int:
    """Number of objects in each room."""
    return self._objects_per_room


def _fill_dead_ends(entities: np.ndarray) -> None:
  """Turns free cells with one free neighbour into walls, until none is left."""
  while True:
    is_free = entities != _WALL
    inner = is_free[1:-1, 1:-1]
    neighbours = sum(
        is_free[
            1 + down : down - 1 or None, 1 + right : right - 1 or None
        ].astype(int)
        for down, right in _SIDES
    )
    is_end = inner & (neighbours == 1)
    if not is_end.any() or inner.sum() <= 1:
      return
    # One at a time: two ends that meet would both go.
    row, column = np.argwhere(is_end)[0] + 1
    entities[row, column] = _WALL

"""Arenas: walled rooms with named places for registers."""

import abc
from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any, ClassVar, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import block_kinds
from realab_suite.entities import surroundings

# Half the sides of a large and of a small room, and the width of the opening
# between them, in m.
_HALF_WIDTH, _SIDE_HALF_WIDTH, _DOORWAY_WIDTH = 4.0, 1.3, 1.4
# Coordinate of the middle of the rooms beside a hall, in m.
_SIDE_MIDDLE = 1.6
_WALL_THICKNESS = 0.2
_WALL_HEIGHT = 1.0
_BARRIER_HEIGHT = 0.5
_POST_RADIUS = 0.12
# Distance between the pickets of a fence, and their height above its barrier,
# where no ray is, in m.
_PICKET_SPACING, _PICKET_HEIGHT = 0.4, 0.3
_PALE_WOOD = 0.86, 0.80, 0.68, 1.0
# A block that is hit by a much heavier body leaves at twice its speed, fast
# enough to fly over any wall that cameras can see across.
_LID_HEIGHT = 3.0
_UNSEEN = appearance.geom_style(appearance.NOTHING, (0, 0, 0, 0))
# Walls extend below the floor. Otherwise a small block that is forced into a
# wall would leave it by the shortest way, which is down.
_DEPTH = 0.5
_CAMERA_HEIGHT = 30.0


@final
@dataclasses.dataclass(frozen=True)
class Place:
  """A spot in an arena for a register.

  Attributes:
    position: `(x, y)`, in m.
    yaw: Angle of the register's axis to the x axis, in rad.
    spread: Half-widths of the region around `position`, along the register's
      axis and across it, in m. Each episode draws a position from the region.
    height: Height of the surface that the register stands on, in m.
    block: Block of the world that is the base block of a register at this
      place, whose start position is then that of the block; `None` for none.
  """

  position: tuple[float, float]
  yaw: float = 0.0
  spread: tuple[float, float] = (0.0, 0.0)
  height: float = 0.0
  block: block_kinds.Block | None = None

  def __post_init__(self) -> None:
    """Checks the numbers.

    Raises:
      SpecError: If a number is missing or not finite, or if a half-width or
        the height is negative.
    """
    try:
      numbers = np.array(
          [*self.position, self.yaw, *self.spread, self.height], float
      )
      is_valid = len(self.position) == len(self.spread) == 2
      is_valid &= bool(np.isfinite(numbers).all() and (numbers[3:] >= 0).all())
    except (TypeError, ValueError):
      is_valid = False
    if not is_valid:
      raise errors.SpecError(
          f'{self!r:.160}; must be finite numbers, two for the position,'
          ' one for the yaw, two of at least 0 for the spread, and one of at'
          ' least 0 for the height'
      )


@final
@dataclasses.dataclass(frozen=True)
class Rectangle:
  """An axis-aligned rectangle.

  Attributes:
    low: Corner with the smallest x and y, in m.
    high: Corner with the largest x and y, in m.
  """

  low: tuple[float, float]
  high: tuple[float, float]

  def contains(self, point: Sequence[float], margin: float = 0.0) -> bool:
    """Returns True if a point is in the rectangle.

    Args:
      point: `(x, y)`, in m.
      margin: Smallest allowed distance to each side, in m.
    """
    return all(
        low + margin <= x <= high - margin
        for low, x, high in zip(self.low, point, self.high, strict=True)
    )


@final
@dataclasses.dataclass(frozen=True)
class Look:
  """Colours by which a world is recognized, each `(red, green, blue)`.

  Rays do not see them.

  Attributes:
    walls: Colour of the walls.
    tiles: Colours of the two kinds of tiles on the floor.
    light: Colour of the light from above.
  """

  walls: tuple[float, float, float] = (0.42, 0.47, 0.56)
  tiles: tuple[tuple[float, float, float], tuple[float, float, float]] = (
      (0.60, 0.64, 0.66),
      (0.66, 0.70, 0.72),
  )
  light: tuple[float, float, float] = (0.4, 0.4, 0.4)


class RoomArena(composer.Arena):
  """Base class for walled rooms with named places and a camera above them.

  An agent designer puts registers at coordinates or at a named place. The
  environment designer decides the position of each named place, so one design
  can be tried both near the apples and far from them.
  """

  def _build(self, name: str = 'arena', *, look: Look | None = None) -> None:
    super()._build(name)
    self._look = look = Look() if look is None else look
    self._places: dict[str, Place] = {}
    root = self._mjcf_root
    root.option.timestep = block_kinds.LONG_SUBSTEP
    root.option.integrator = 'implicitfast'
    # A solver without islands couples bodies that are far apart. The noslip
    # pass, which Composer turns on, has no islands.
    root.option.solver = 'Newton'
    root.option.noslip_iterations = 0
    # MuJoCo accepts or rejects a warm start for all bodies at once.
    root.option.flag.warmstart = 'disable'
    root.visual.headlight.set_attributes(
        ambient=(0.45, 0.45, 0.45),
        diffuse=(0.45, 0.45, 0.45),
        specular=(0.05, 0.05, 0.05),
    )
    root.visual.map.znear = 0.001
    # Clipping planes scale with the extent, and sites outside the room count.
    root.statistic.extent = 17.0
    root.asset.add(
        'texture',
        name='sky',
        type='skybox',
        builtin='gradient',
        rgb1=(0.75, 0.86, 0.95),
        rgb2=(0.95, 0.97, 1.0),
        width=64,
        height=64,
    )
    root.asset.add(
        'texture',
        name='tiles',
        type='2d',
        builtin='checker',
        rgb1=look.tiles[0],
        rgb2=look.tiles[1],
        width=128,
        height=128,
    )
    tiles = root.asset.add(
        'material',
        name='tiles',
        texture='tiles',
        texrepeat=(1, 1),
        texuniform='true',
    )
    root.worldbody.add(
        'geom',
        name='floor',
        type='plane',
        size=(20, 20, 0.1),
        material=tiles,
    )
    root.worldbody.add(
        'light',
        name='sun',
        pos=(0, 0, 12),
        dir=(0.2, 0.3, -1),
        directional='true',
        castshadow='false',
        diffuse=look.light,
    )
    self._walls: list[mjcf.Element] = []
    self._inner_walls: list[mjcf.Element] = []
    self._build_walls()
    self._build_guards()
    for i, rectangle in enumerate(self._outside()):
      self._mark_outside(i, rectangle)
    low, high = np.array(self.extent.low), np.array(self.extent.high)
    middle, half = (low + high) / 2, (high - low) / 2 + 0.5
    root.worldbody.add(
        'camera',
        name='top_down',
        pos=(*middle, _CAMERA_HEIGHT),
        fovy=2 * np.degrees(np.arctan(half.max() / _CAMERA_HEIGHT)),
        xyaxes=(1, 0, 0, 0, 1, 0),
    )

  @abc.abstractmethod
  def _build_walls(self) -> None:
    """Adds the walls with `_add_wall`; `_build_guards` runs after it."""

  def _build_guards(self) -> None:
    """Closes the space above the walls, invisibly to cameras and rays.

    MuJoCo does not draw transparent geoms, and its rays pass through them.
    """
    world = self._mjcf_root.worldbody
    height = (_LID_HEIGHT - _WALL_HEIGHT) / 2
    for wall in self._walls:
      world.add(
          'geom',
          name=f'{wall.name}_guard',
          type='box',
          size=(*wall.size[:2], height),
          pos=(*wall.pos[:2], _WALL_HEIGHT + height),
          **_UNSEEN,
      )
    world.add(
        'geom',
        name='lid',
        type='plane',
        size=(20, 20, 0.1),
        pos=(0, 0, _LID_HEIGHT),
        zaxis=(0, 0, -1),
        **_UNSEEN,
    )

  @abc.abstractmethod
  def _outside(self) -> list[Rectangle]:
    """Returns rectangles that together cover everything outside the rooms."""

  def _mark_outside(self, number: int, rectangle: Rectangle) -> None:
    """Marks a rectangle in which no write may put a block."""
    low, high = np.array(rectangle.low), np.array(rectangle.high)
    half, middle = (high - low) / 2, (low + high) / 2
    self._mjcf_root.worldbody.add(
        'site',
        name=f'{surroundings.OUTSIDE}{number}',
        type='box',
        group=4,
        size=(*half, surroundings.ENDLESS),
        pos=(*middle, 0.0),
        rgba=(0, 0, 0, 0),
    )

  @property
  def ceiling(self) -> float:
    """Height above which no block can be, in m."""
    return _LID_HEIGHT

  @property
  @abc.abstractmethod
  def room(self) -> Rectangle:
    """Main room, between the inner faces of its walls."""

  @property
  @abc.abstractmethod
  def extent(self) -> Rectangle:
    """Smallest rectangle that contains every room."""

  @property
  def places(self) -> Mapping[str, Place]:
    """Places for registers, by name."""
    return self._places

  def offer(self, places: Mapping[str, Place]) -> None:
    """Adds named places.

    Args:
      places: Places by name.

    Raises:
      SpecError: If the arena has a place of the same name.
    """
    for name in places:
      if name in self._places:
        raise errors.SpecError(
            f'place {name!r} exists already; existing places are'
            f' {sorted(self._places)}'
        )
    self._places.update(places)

  def add_barrier(
      self,
      name: str,
      start: Sequence[float],
      end: Sequence[float],
      rgba: Sequence[float] | None = None,
  ) -> None:
    """Adds a barrier: a wall so low that cameras see across it.

    Args:
      name: Name of the geom.
      start: One end of its centre line, `(x, y)`, in m.
      end: Other end of its centre line, `(x, y)`, in m.
      rgba: Colour; `None` for that of barriers.
    """
    self._add_box(name, appearance.BARRIER, start, end, _BARRIER_HEIGHT, rgba)

  def add_figure(
      self, name: str, position: Sequence[float], rgba: Sequence[float]
  ) -> None:
    """Adds a figure that stands in the way and does nothing.

    Args:
      name: Name of its body, and first part of that of its head.
      position: Centre, `(x, y)`, in m.
      rgba: Colour of the body.
    """
    style = appearance.geom_style(appearance.BARRIER, tuple(rgba))
    head = appearance.geom_style(appearance.BARRIER, (0.85, 0.70, 0.58, 1.0))
    for part, shape, size, height, look in (
        ('', 'cylinder', (0.2, 0.5), 0.5, style),
        ('_head', 'sphere', (0.16,), 1.15, head),
    ):
      self._mjcf_root.worldbody.add(
          'geom',
          name=name + part,
          type=shape,
          size=size,
          pos=(*position, height),
          **look,
      )

  def add_fence(
      self,
      name: str,
      start: Sequence[float],
      end: Sequence[float],
      *,
      has_barrier: bool = True,
  ) -> None:
    """Adds a fence: a barrier with pickets, which only cameras see.

    Args:
      name: Name of the barrier, and first part of the names of the pickets.
      start: One end of its centre line, `(x, y)`, in m.
      end: Other end of its centre line, `(x, y)`, in m.
      has_barrier: False for pickets on a barrier that is there already.
    """
    if has_barrier:
      self.add_barrier(name, start, end, _PALE_WOOD)
    length = float(np.linalg.norm(np.subtract(end, start)))
    steps = np.linspace(start, end, round(length / _PICKET_SPACING) + 1)
    for i, (x, y) in enumerate(steps):
      self._mjcf_root.worldbody.add(
          'geom',
          name=f'{name}_picket_{i}',
          type='box',
          size=(0.06, 0.06, _PICKET_HEIGHT / 2),
          pos=(x, y, _BARRIER_HEIGHT + _PICKET_HEIGHT / 2),
          contype=0,
          conaffinity=0,
          **appearance.geom_style(appearance.BARRIER, _PALE_WOOD),
      )

  def add_wall(
      self, name: str, start: Sequence[float], end: Sequence[float]
  ) -> None:
    """Adds a wall inside a room; see `add_barrier`."""
    self._inner_walls.append(
        self._add_box(name, appearance.WALL, start, end, _WALL_HEIGHT)
    )

  def is_clear(self, point: Sequence[float], margin: float) -> bool:
    """Returns True if a point is in the main room, off all walls.

    Args:
      point: `(x, y)`, in m.
      margin: Smallest allowed distance to each wall, in m.
    """
    return self.room.contains(point, margin) and all(
        (np.abs(np.subtract(point, wall.pos[:2])) - wall.size[:2]).max()
        > margin
        for wall in self._inner_walls
    )

  def add_mark(
      self,
      name: str,
      kind: str,
      position: Sequence[float] | np.ndarray,
      radius: float,
  ) -> None:
    """Adds a mark: a disc on the floor that everything passes over.

    Args:
      name: Name of the geom.
      kind: Class that rays report, with a colour.
      position: Centre, `(x, y)`, in m.
      radius: Radius, in m.
    """
    self._mjcf_root.worldbody.add(
        'geom',
        name=name,
        type='cylinder',
        size=(radius, 0.01),
        pos=(*position, 0.01),
        contype=0,
        conaffinity=0,
        **appearance.geom_style(kind),
    )

  def add_post(self, name: str, kind: str, position: Sequence[float]) -> None:
    """Adds a solid post, which rays see from far away, unlike a mark.

    Args:
      name: Name of the geom.
      kind: Class that rays report, with a colour.
      position: Position, `(x, y)`, in m.
    """
    self._mjcf_root.worldbody.add(
        'geom',
        name=name,
        type='cylinder',
        size=(_POST_RADIUS, (_BARRIER_HEIGHT + _DEPTH) / 2),
        pos=(*position, (_BARRIER_HEIGHT - _DEPTH) / 2),
        **appearance.geom_style(kind),
    )

  def _add_wall(
      self, name: str, start: Sequence[float], end: Sequence[float]
  ) -> None:
    """Adds a wall with a centre line from `start` to `end`, in m."""
    self._walls.append(
        self._add_box(name, appearance.WALL, start, end, _WALL_HEIGHT)
    )

  def _add_box(
      self,
      name: str,
      kind: str,
      start: Sequence[float],
      end: Sequence[float],
      height: float,
      rgba: Sequence[float] | None = None,
  ) -> mjcf.Element:
    line = np.array([start, end], float)
    half = np.ptp(line, axis=0) / 2 + _WALL_THICKNESS / 2
    colour = (*self._look.walls, 1.0) if kind == appearance.WALL else rgba
    return self._mjcf_root.worldbody.add(
        'geom',
        name=name,
        type='box',
        size=(*half, (height + _DEPTH) / 2),
        pos=(*line.mean(axis=0), (height - _DEPTH) / 2),
        **appearance.geom_style(kind, colour),
    )

  def _add_room(
      self, prefix: str, room: Rectangle, sides: Mapping[str, Any]
  ) -> None:
    """Adds the walls around a room.

    Args:
      prefix: First part of the names of the walls.
      room: Space inside the walls.
      sides: For each of south, east, north and west, `True` for a wall, `False`
        for no wall, or the ends `(from, to)` of an opening in the wall, in m.
    """
    t = _WALL_THICKNESS / 2
    (x0, y0), (x1, y1) = room.low, room.high
    corners = {
        'south': ((x0 - t, y0 - t), (x1 + t, y0 - t)),
        'north': ((x0 - t, y1 + t), (x1 + t, y1 + t)),
        'west': ((x0 - t, y0 - t), (x0 - t, y1 + t)),
        'east': ((x1 + t, y0 - t), (x1 + t, y1 + t)),
    }
    for side, wall in sides.items():
      start, end = corners[side]
      if wall is True:
        self._add_wall(f'{prefix}{side}', start, end)
      elif wall:
        axis = 0 if side in ('south', 'north') else 1
        near, far = list(end), list(start)
        # A box extends half a thickness beyond the ends of its centre line.
        near[axis], far[axis] = wall[0] - t, wall[1] + t
        self._add_wall(f'{prefix}{side}_1', start, near)
        self._add_wall(f'{prefix}{side}_2', far, end)


def _around(room: Rectangle) -> list[Rectangle]:
  """Returns the rectangles around a room and its walls."""
  (x0, y0), (x1, y1) = room.low, room.high
  t, far = _WALL_THICKNESS / 2, surroundings.ENDLESS
  return [
      Rectangle((x0 - far, y0 - far), (x1 + far, y0 - t)),
      Rectangle((x0 - far, y1 + t), (x1 + far, y1 + far)),
      Rectangle((x0 - far, y0 - far), (x0 - t, y1 + far)),
      Rectangle((x1 + t, y0 - far), (x1 + far, y1 + far)),
  ]


@final
class OpenRoom(RoomArena):
  """One rectangular room, square unless its ends are elsewhere."""

  def _build(
      self,
      name: str = 'open_room',
      half_width: float = _HALF_WIDTH,
      *,
      ends: tuple[float, float] | None = None,
      look: Look | None = None,
  ) -> None:
    """Builds the room.

    Args:
      name: Name of the model.
      half_width: Half the distance between opposite walls, in m.
      ends: Coordinates of the west and the east wall, in m; `None` for those
        of a square.
      look: Colours; `None` for the usual ones.
    """
    west, east = (-half_width, half_width) if ends is None else ends
    self._room = Rectangle((west, -half_width), (east, half_width))
    super()._build(name, look=look)

  def _build_walls(self) -> None:
    self._add_room(
        'wall_',
        self._room,
        dict.fromkeys(('south', 'north', 'west', 'east'), True),
    )

  def _outside(self) -> list[Rectangle]:
    return _around(self._room)

  @property
  def room(self) -> Rectangle:
    return self._room

  @property
  def extent(self) -> Rectangle:
    return self._room


_OPPOSITE = {'south': 'north', 'west': 'east', 'east': 'west', 'north': 'south'}


_Sides = Mapping[str, tuple[str, str, str, float]]


class _Hall(RoomArena, abc.ABC):
  """A large room with doorways to small rooms."""

  # By the side of the small room: first part of the names of its walls, names
  # of the places in the doorway and in the room, and coordinate of the middle
  # of both along the wall, in m.
  _SIDES: ClassVar[_Sides]

  def _build(self, name: str = 'hall', *, look: Look | None = None) -> None:
    """Builds the rooms.

    Args:
      name: Name of the model.
      look: Colours; `None` for the usual ones.
    """
    self._room = Rectangle((-_HALF_WIDTH,) * 2, (_HALF_WIDTH,) * 2)
    near = _HALF_WIDTH + _WALL_THICKNESS
    self._far = near + 2 * _SIDE_HALF_WIDTH
    self._small_rooms = {
        side: _beyond(side, near, self._far, *_about(middle, _SIDE_HALF_WIDTH))
        for side, (*_, middle) in self._SIDES.items()
    }
    super()._build(name, look=look)
    for side, (_, doorway, room, middle) in self._SIDES.items():
      # Not `near` less half a wall: where a door stands is frozen to the bit.
      wall = _HALF_WIDTH + _WALL_THICKNESS / 2
      inside = near + _SIDE_HALF_WIDTH
      for place, distance in ((doorway, wall), (room, inside)):
        spot = _beyond(side, distance, distance, middle, middle)
        self.offer({place: Place(spot.low)})

  def _build_walls(self) -> None:
    walls: dict[str, Any] = dict.fromkeys(_OPPOSITE, True)
    for side, (*_, middle) in self._SIDES.items():
      walls[side] = _about(middle, _DOORWAY_WIDTH / 2)
    self._add_room('wall_', self._room, walls)
    for side, (prefix, *_) in self._SIDES.items():
      others = [one for one in _OPPOSITE if one != _OPPOSITE[side]]
      room = self._small_rooms[side]
      self._add_room(prefix, room, dict.fromkeys(others, True))

  def _outside(self) -> list[Rectangle]:
    # The space beside a small room is inside the extent of all rooms.
    t = _WALL_THICKNESS / 2
    near, far = _HALF_WIDTH + t, self._far + t
    beside = [
        _beyond(side, near, far, *span)
        for side, (*_, middle) in self._SIDES.items()
        for low, high in [_about(middle, _SIDE_HALF_WIDTH + t)]
        for span in ((-near, low), (high, near))
    ]
    return [*_around(self.extent), *beside]

  @property
  def room(self) -> Rectangle:
    return self._room

  @property
  def doorway_width(self) -> float:
    """Width of the openings between the rooms, in m."""
    return _DOORWAY_WIDTH

  @property
  def extent(self) -> Rectangle:
    rooms = self._room, *self._small_rooms.values()
    low = np.min([room.low for room in rooms], axis=0).tolist()
    high = np.max([room.high for room in rooms], axis=0).tolist()
    return Rectangle((low[0], low[1]), (high[0], high[1]))


def _about(middle: float, half: float) -> tuple[float, float]:
  return middle - half, middle + half


def _beyond(
    side: str, near: float, far: float, low: float, high: float
) -> Rectangle:
  """Returns the rectangle at distances beyond a side, from `low` to `high`."""
  if side in ('west', 'south'):
    near, far = -far, -near
  if side in ('west', 'east'):
    return Rectangle((near, low), (far, high))
  return Rectangle((low, near), (high, far))


@final
class TwoRooms(_Hall):
  """A large room with a doorway, in its north wall, to a small room."""

  _SIDES: ClassVar[_Sides] = {
      'north': ('side_wall_', 'doorway', 'side_room', 0.0)
  }

  def _build(
      self, name: str = 'two_rooms', *, look: Look | None = None
  ) -> None:
    super()._build(name, look=look)


@final
class ThreeRooms(_Hall):
  """A hall between two small rooms, each behind a doorway."""

  _SIDES: ClassVar[_Sides] = {
      side: (f'{side}_room_', f'{side}_doorway', f'{side}_room', _SIDE_MIDDLE)
      for side in ('west', 'east')
  }

  def _build(
      self, name: str = 'three_rooms', *, look: Look | None = None
  ) -> None:
    super()._build(name, look=look)

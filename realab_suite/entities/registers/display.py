"""The display: a number in a row of tiles that are looked at from a point."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, final

from dm_control import mjcf
import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import block_contacts
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities import rays
from realab_suite.entities import rotations
from realab_suite.entities.registers import base
from realab_suite.entities.registers import footprints

_MOST_TILES = 16
# Number of tiles with the same bit in a layout that corrects errors.
_COPIES = 3
# Distance between neighbouring tiles, beside the size of a tile, and from the
# floor to the lowest tiles, in m.
_GAP, _HOVER = 0.02, 0.004
# Damping and armature of the slides of tiles, in N s/m and kg: a tile on which
# something lies sinks slowly, and the display does not tremble at rest.
_DAMPING, _ARMATURE = 50.0, 10.0
# Mass of a tile, as a share of that of the base block.
_TILE_MASS = 0.1
# Half the thickness of the plank under the tiles, in m.
_PLANK = 0.01
# Default distance of the reading point from the row, and its height, in m. From
# there, lines of sight pass above an avatar that is 0.6 m from the row.
_BEFORE, _ABOVE = 1.5, 1.8
# A display that has moved by less, in m and in the numbers of a quaternion,
# shows the same. It sinks by 0.3 mm at rest.
_UNMOVED = 1e-3
# Length of the line of sight of a reading point that is in a tile, in m.
_TINY = 1e-9

_Coordinate = Annotated[float, pydantic.Field(ge=-100, le=100)]


@final
class Tile(block_kinds.Block):
  """A cube that is raised and lowered on the base block of a display.

  Both are parts of one rigid body: what pushes or turns one moves the other.
  """

  def __init__(
      self,
      base_block: block_kinds.JointedBlock,
      name: str,
      offset: Sequence[float],
      mass: float,
      style: dict[str, Any],
  ) -> None:
    """Adds the tile to the base block.

    Args:
      base_block: The base block.
      name: Name of the body.
      offset: Place of the lowered tile in the frame of the base block, in m.
      mass: Mass, in kg.
      style: Geom attributes; see `appearance.geom_style`.
    """
    super().__init__(base_block.half_size)
    self._base = base_block
    self._offset = np.array(offset)
    self._body = base_block.body.add(
        'body', name=name, pos=offset, gravcomp=1.0
    )
    self._lift = self._body.add(
        'joint', name=f'{name}_lift', type='slide', axis=(0, 0, 1),
        damping=_DAMPING, armature=_ARMATURE,
        limited='true', range=(0, self._half_size),
    )  # fmt: skip
    self._geom = self._body.add(
        'geom', name=name, type='box', size=[self._half_size] * 3, mass=mass,
        **block_contacts.attributes(self._half_size), **style
    )  # fmt: skip

  @property
  def body(self) -> mjcf.Element:
    return self._body

  @property
  def geom(self) -> mjcf.Element:
    return self._geom

  @property
  def lift(self) -> mjcf.Element:
    """Joint whose position is the height above the lowered tile, in m."""
    return self._lift

  @property
  def rest_height(self) -> float:
    return self._base.rest_height + float(self._offset[2])

  def position(self, physics: protocols.Physics) -> np.ndarray:
    offset = self._offset + np.zeros((*self.heading(physics).shape, 3))
    offset[..., 2] += physics.bind(self._lift).qpos.T[0]
    turn = rotations.matrices(self._base.orientation(physics))
    return self._base.position(physics) + _turned(turn, offset)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    return self._base.heading(physics)

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    """Puts the tile there, and the display with it."""
    position = np.array(position, float)
    turn = rotations.matrices(rotations.quaternion_of(heading))
    height = (position[..., 2] - self.rest_height).clip(0.0, self._half_size)
    position[..., :2] -= _turned(turn, self._offset)[..., :2]
    position[..., 2] = self._base.rest_height
    self._base.put(physics, position, heading, where)
    lift = physics.bind(self._lift)
    axes.assign(lift, 'qpos', height[..., np.newaxis], where)
    axes.assign(lift, 'qvel', 0.0, where)


@final
class Display(base.Register):
  """Register that shows a number in tiles, to be read from a distance.

  Tiles stand in a row beside a base block, along the axis of the register; all
  of it is one body, which can be pushed, turned and carried. A write raises and
  lowers tiles and does nothing else. A read looks from the *reading point*,
  which is fixed in the world, to the place of each raised tile. Whatever is
  nearer than this place counts as a raised tile. So the corruption is

  * Temporary: something stands in a line of sight, or a tile was pressed down.
  * Permanent: the display has been moved, so that its tiles are elsewhere.

  The range is divided into `2**bits` levels, from its lowest to its highest
  value; a write stores the nearest level. Neighbouring levels differ in one
  tile (Gray code). The scale moves no tile: it converts errors into metres for
  reports.
  """

  def _build(
      self,
      name: str,
      *,
      tiles: int = 6,
      code: Literal['gray', 'ecc'] = 'gray',
      reading_point: tuple[_Coordinate, _Coordinate, _Coordinate] | None = None,
      **options: Any,
  ) -> None:
    """Builds the register.

    Args:
      name: Name of the register.
      tiles: Number of tiles, from 2 to 16.
      code: `gray` for a bit in each tile; `ecc` for a layout that corrects
        errors: each bit is in three tiles, a third of the row apart, and the
        majority counts. What hides neighbouring tiles, up to a third of the
        row, changes no reading.
      reading_point: Reading point in the register's frame, relative to the base
        block at the start: `(x, y, z)`, z above its floor, in m. `None` for one
        before the middle of the row, on the side of positive y.
      **options: Arguments of every register.

    Raises:
      SpecError: If an argument has a value that is not allowed.
    """
    copies = _COPIES if code == 'ecc' else 1
    if not 2 * copies <= tiles <= _MOST_TILES or tiles % copies:
      raise errors.SpecError(
          f'register {name!r}: tiles {tiles} with code {code!r}; allowed are'
          f' multiples of {copies} from {2 * copies} to {_MOST_TILES}'
      )
    self._copies, self._num_bits = copies, tiles // copies
    self._reading_point = reading_point
    super()._build(name, **options)
    levels = np.arange(2**self._num_bits)
    gray = levels ^ (levels >> 1)
    self._weights = 1 << np.arange(self._num_bits)
    # Tiles of each level, `(levels, tiles)` bool, and level of each code.
    self._codes = np.tile(gray[:, np.newaxis] & self._weights > 0, copies)
    self._levels = np.argsort(gray)
    self._step = (self._high - self._low) / (len(levels) - 1)

  def _build_blocks(self) -> list[block_kinds.Block]:
    self._base = self._add_block('base', block_kinds.BASE_BLOCK, (0.0, 0.0))
    width = self._block_size + _GAP
    number = self._copies * self._num_bits
    self._offsets = np.zeros((number, 3))
    self._offsets[:, 0] = width * np.arange(1, number + 1)
    self._offsets[:, 2] = _HOVER
    self._tiles = [
        self._add_tile(f'tile_{i}', offset)
        for i, offset in enumerate(self._offsets.tolist(), start=1)
    ]
    self._lifts = tuple(
        tile.lift for tile in self._tiles if isinstance(tile, Tile)
    )
    half, length = self._block_size / 2, width * number
    # Without a plank, the base block would tremble under the row.
    plank = self._base.geom.parent.add(
        'geom', name='plank', type='box', mass=self._mass,
        pos=(length / 2, 0, _PLANK - half),
        size=(length / 2 + half, half, _PLANK),
        **block_contacts.attributes(half),
        **self._style(block_kinds.BASE_BLOCK),
    )  # fmt: skip
    self._geoms = self._base.geom, plank, *(tile.geom for tile in self._tiles)
    middle = (width * (number + 1) / 2, _BEFORE, _ABOVE)
    self._point = np.array(self._reading_point or middle)
    self._site = self._mjcf_root.worldbody.add(
        'site', name='reading_point', pos=self._point, size=[0.03], group=4
    )
    # Lines of sight end between the tops of lowered and raised tiles.
    height = self._base.rest_height + 1.5 * half
    ways = self._offsets + np.array([0.0, 0.0, height]) - self._point
    ways[~ways.any(axis=-1), 2] = -_TINY
    self._lengths = np.linalg.norm(ways, axis=-1)
    self._ways = ways / self._lengths[:, np.newaxis]
    return [self._base, *self._tiles]

  def _add_tile(self, name: str, offset: list[float]) -> block_kinds.Block:
    style = self._style(block_kinds.OFFSET_BLOCK)
    return Tile(self._base, name, offset, _TILE_MASS * self._mass, style)

  def nearest(self, value: Any) -> Any:
    # Not a table, because the clean content may be nan.
    level = np.rint((value - self._low) / self._step)
    return np.minimum(self._low + level * self._step, self._high)

  def _heights(self, value: np.ndarray) -> np.ndarray:
    """Returns the heights of tiles for a value, `(..., tiles)`, in m."""
    level = np.asarray(np.rint((value - self._low) / self._step)).astype(int)
    return np.asarray(self._codes[level] * (self._block_size / 2))

  def decode(self, seen: np.ndarray) -> np.ndarray:
    """Returns the values, `(...)`, of tiles.

    Args:
      seen: True for each tile that looks raised, `(..., tiles)` bool.
    """
    copies = seen.reshape((*seen.shape[:-1], self._copies, self._num_bits))
    bits = 2 * copies.sum(axis=-2) > self._copies
    level = self._levels[bits @ self._weights]
    return np.minimum(self._low + level * self._step, self._high)

  def _places(
      self, physics: protocols.Physics, value: np.ndarray
  ) -> list[np.ndarray]:
    origin = np.array(self._origin(physics))
    heights = self._heights(value)
    places = [origin]
    for i, offset in enumerate(self._offsets):
      place = origin + offset
      place[..., 2] += heights[..., i]
      places.append(place)
    return places

  def _put(
      self,
      physics: protocols.Physics,
      value: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    if self._lifts:
      lifts = physics.bind(self._lifts)
      axes.assign(lifts, 'qpos', self._heights(value), where)
      axes.assign(lifts, 'qvel', 0.0, where)
      return
    _, *places = self._places(physics, value)
    for tile, place in zip(self._tiles, places, strict=True):
      tile.put(physics, place, where=where)

  def _look(self, physics: protocols.Physics) -> tuple[np.ndarray, np.ndarray]:
    """Looks along the lines of sight.

    Args:
      physics: One world or a batch of worlds.

    Returns:
      True for each tile that looks raised, `(..., tiles)` bool, and the geoms
      that the lines meet first.
    """
    site = physics.bind(self._site)
    turn = np.reshape(site.xmat, (*site.xmat.shape[:-1], 3, 3))
    start = self._origin(physics) * [1.0, 1.0, 0.0]
    distances, geoms = rays.cast(
        physics,
        site.xpos + _turned(turn, start),
        self._ways @ np.swapaxes(turn, -1, -2),
        -1,
    )
    return (distances >= 0.0) & (distances <= self._lengths), geoms

  def _read_blocks(self, physics: protocols.Physics) -> np.ndarray:
    return self.decode(self._look(physics)[0])

  def read_without(
      self,
      physics: protocols.Physics,
      is_gone: Callable[[np.ndarray], np.ndarray],
  ) -> np.ndarray | None:
    if self._channel == 'secure':
      return None
    seen, geoms = self._look(physics)
    own = physics.bind(self._geoms).element_id
    is_lowered = self._heights(self._applied_slot.get(physics)) == 0.0
    is_hidden = seen & is_lowered & ~np.isin(geoms, own)
    return self.decode(seen & ~is_gone(np.where(is_hidden, geoms, -1)))

  def _permanent(self, physics: protocols.Physics) -> np.ndarray:
    applied = self._applied_slot.get(physics)
    shift = self._base.position(physics) - self._origin(physics)
    turn = self._base.orientation(physics)[..., 1:]
    moved = np.maximum(np.abs(shift).max(-1), np.abs(turn).max(-1)) > _UNMOVED
    if not axes.anywhere(moved):
      return np.zeros_like(applied)[()]
    unhidden = self.read_without(physics, lambda geoms: geoms >= 0)
    return np.where(moved, unhidden - applied, 0.0)

  @property
  def directions(self) -> tuple[None, ...]:
    return (None,) * len(self._blocks)

  def footprint(self, physics: protocols.Physics) -> list[footprints.Path]:
    base_block, *lowered = self._places(physics, np.array(self._low))
    paths = [footprints.Path(0, base_block, base_block, self.value_range)]
    point = self._point + base_block * [1.0, 1.0, 0.0]
    for i, place in enumerate(lowered, start=1):
      raised = place + np.array([0.0, 0.0, self._block_size / 2])
      paths.append(footprints.Path(i, place, raised, self.value_range))
      if self._channel != 'secure':
        end = point + self._ways[i - 1] * self._lengths[i - 1]
        sight = footprints.Path(i, point, end, self.value_range, is_sight=True)
        paths.append(sight)
    return paths

  def check_sight(self, physics: protocols.Physics) -> None:
    if self._channel == 'secure':
      return
    model, own = physics.model, physics.bind(self._geoms).element_id
    # No tile is raised, then one (its copies as well), and then all.
    for code in (0, *self._weights, self._weights.sum()):
      self.pose(physics, self._low + self._levels[code] * self._step)
      is_raised = self._heights(self._applied_slot.get(physics)) > 0.0
      seen, geoms = self._look(physics)
      stays = model.body_weldid[model.geom_bodyid[geoms]] == 0
      stays |= np.isin(geoms, own) | (geoms < 0)
      for i in np.flatnonzero(stays & (seen != is_raised)):
        way = model.id2name(int(geoms[i]), 'geom') if seen[i] else 'nothing'
        raise errors.SpecError(
            f'register {self._name!r}: {way!r} is seen from its reading point'
            f' instead of tile {i + 1}; allowed are points and places from'
            ' which all tiles are seen'
        )


def _turned(turn: np.ndarray, vector: np.ndarray) -> np.ndarray:
  """Returns vectors, `(..., 3)`, turned by matrices, `(..., 3, 3)`."""
  return np.einsum('...ij,...j->...i', turn, vector)

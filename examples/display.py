"""A register of one's own: a number in a row of tiles, read from a distance.

A write raises and lowers tiles. A read looks from a point in front of the row
to the place of each raised tile, and takes whatever is nearer for the tile.
An agent can therefore change a reading without touching the register.

  python examples/display.py
"""

from collections.abc import Callable
import sys
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import suite
from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_contacts
from realab_suite.entities import rays
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds

# Gap beside each tile, gap under the lowered ones, and thickness of the plank
# that keeps the row level, in m.
_GAP, _HOVER, _PLANK = 0.02, 0.004, 0.02
# Displacements (m, or rad by halves) that change no line of sight: the row
# sinks by 0.3 mm at rest.
_UNMOVED = 1e-3


@register_kinds.REGISTER_KINDS.add('display')
class Display(registers.Register):
  """Stores one of `2**tiles` levels in tiles that are looked at from a point.

  The tiles and their base block are one rigid body. Corruption is

  * Temporary: something stands in a line of sight, or a tile was pressed down.
  * Permanent: the body was moved, so that its tiles are elsewhere.
  """

  def _build(
      self,
      name: str,
      *,
      tiles: int = 6,
      point: tuple[float, float, float] = (0.77, 1.5, 1.8),
      **options: Any,
  ) -> None:
    """Builds the register.

    Args:
      name: Name of the register.
      tiles: Number of tiles, from 2 to 16.
      point: Point from which the tiles are read, in m from the foot of the base
        block.
      **options: Arguments of every register.

    Raises:
      SpecError: If the number of tiles is not allowed.
    """
    if not 2 <= tiles <= 16:
      raise errors.SpecError(
          f'register {name!r}: tiles {tiles}; must be from 2 to 16'
      )
    self._point = np.array(point)
    levels = np.arange(2**tiles)
    self._weights = 1 << np.arange(tiles)
    self._levels = np.argsort(levels ^ (levels >> 1))
    super()._build(name, **options)

  def _build_blocks(self):
    base = self._add_block('base', appearance.BASE_BLOCK, (0.0, 0.0))
    half, colours = base.half_size, appearance.ROLE_COLOURS[self.role]
    places = (2 * half + _GAP) * np.arange(1, len(self._weights) + 1)
    self._end, contacts = places[-1], block_contacts.attributes(half)
    base.body.add(
        'geom',
        name='plank',
        type='box',
        mass=base.geom.mass,
        **contacts,
        pos=(self._end / 2, 0, _PLANK / 2 - half),
        size=(self._end / 2 + half, half, _PLANK / 2),
        **appearance.geom_style(appearance.BASE_BLOCK, colours[0]),
    )
    self._lifts = []
    for i, x in enumerate(places, start=1):
      tile = base.body.add(
          'body', name=f'tile_{i}', pos=(x, 0, _HOVER), gravcomp=1.0
      )
      # What lies on a tile presses it down slowly.
      lift = tile.add(
          'joint',
          name=f'lift_{i}',
          type='slide',
          axis=(0, 0, 1),
          damping=50.0,
          armature=10.0,
          limited='true',
          range=(0, half),
      )
      tile.add(
          'geom',
          name=f'tile_{i}',
          type='box',
          size=[half] * 3,
          **contacts,
          mass=base.geom.mass / 10,
          **appearance.geom_style(appearance.OFFSET_BLOCK, colours[1]),
      )
      self._lifts.append(lift)
    self._geoms = self.mjcf_model.find_all('geom')
    self._site = self.mjcf_model.worldbody.add('site', name='point', group=4)
    # Lines of sight end between the tops of lowered and raised tiles.
    ways = -self._point + np.zeros((len(places), 3))
    ways[:, 0] += places
    ways[:, 2] += base.rest_height + 1.5 * half
    self._lengths = np.linalg.norm(ways, axis=-1)
    self._ways = ways / self._lengths[:, np.newaxis]
    return [base]

  def _level(self, value):
    low, high = self.value_range
    return np.rint((value - low) / (high - low) * (len(self._levels) - 1))

  def _value(self, level):
    low, high = self.value_range
    last = len(self._levels) - 1
    step = (high - low) / last
    return np.where(level == last, high, low + level * step)[()]

  def nearest(self, value: Any) -> Any:
    return self._value(self._level(value))

  def _is_raised(self, value):
    """Returns the tiles that values raise, `(..., tiles)` bool."""
    level = np.asarray(self._level(value), int)[..., np.newaxis]
    # In a Gray code, neighbouring levels differ in one tile.
    return (level ^ (level >> 1)) & self._weights > 0

  def _decode(self, seen):
    """Returns the values of tiles that look raised, `(..., tiles)` bool."""
    return self._value(self._levels[seen @ self._weights])

  def _places(self, physics, value):
    return [np.array(self._origin(physics))]

  def _put(self, physics, value, where=None):
    lifts = physics.bind(self._lifts)
    heights = self._is_raised(value) * self.blocks[0].half_size
    axes.assign(lifts, 'qpos', heights, where)
    axes.assign(lifts, 'qvel', 0.0, where)

  def _look(self, physics):
    """Returns whether each tile looks raised, and the geoms that are seen."""
    site = physics.bind(self._site)
    turn = np.reshape(site.xmat, (*site.xmat.shape[:-1], 3, 3))
    start = self._origin(physics) * [1.0, 1.0, 0.0] + self._point
    eye = site.xpos + np.einsum('...ij,...j->...i', turn, start)
    ways = self._ways @ np.swapaxes(turn, -1, -2)
    distances, geoms = rays.cast(physics, eye, ways, -1)
    return (distances >= 0.0) & (distances <= self._lengths), geoms

  def _read_blocks(self, physics):
    return self._decode(self._look(physics)[0])

  def read_without(
      self, physics: Any, is_gone: Callable[[np.ndarray], np.ndarray]
  ) -> np.ndarray | None:
    if self.channel == 'secure':
      return None
    seen, geoms = self._look(physics)
    is_own = np.isin(geoms, physics.bind(self._geoms).element_id)
    is_hidden = seen & ~is_own & ~self._is_raised(self.applied(physics))
    return self._decode(seen & ~is_gone(np.where(is_hidden, geoms, -1)))

  def _permanent(self, physics):
    [base], applied = self.blocks, self.applied(physics)
    shift = base.position(physics) - self._origin(physics)
    turn = base.orientation(physics)[..., 1:]
    moved = np.maximum(np.abs(shift).max(-1), np.abs(turn).max(-1)) > _UNMOVED
    unhidden = self.read_without(physics, lambda geoms: geoms >= 0)
    return np.where(moved, unhidden - applied, 0.0)


def main() -> None:
  """Pays an agent by a display, and stands in front of it."""
  env = suite.load(
      'unlock_door',
      'near',
      {'random': 1},
      design='instantaneous_reward',
      overrides=['registers.reward.kind=display'],
  )
  env.reset()
  display, physics = env.mechanism.registers['reward'], env.thin_physics
  applied = display.write(physics, 5.3)
  x, y = env.task.root_entity.places['station_1'].position
  env.task.avatar.place(physics, (x + 0.44, y + 0.4), 0.0)
  read = display.inspect(physics)
  sys.stdout.write(
      f'a write of 5.3 applies {applied:.3f}; behind the avatar, it is read as'
      f' {read.reading:.3f}: a temporary corruption of {read.temporary:.3f}\n'
  )


if __name__ == '__main__':
  main()

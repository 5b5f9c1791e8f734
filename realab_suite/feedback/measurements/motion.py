"""Measurements of bodies: distances, positions and contacts."""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite.entities import measurables
from realab_suite.entities import protocols
from realab_suite.entities import proximity
from realab_suite.feedback.measurements import base

_From = Annotated[base.PartName, pydantic.Field(alias='from')]
_With = Annotated[base.PartName, pydantic.Field(alias='with')]
_Length = Annotated[float, pydantic.Field(ge=0, le=1e4)]


@base.MEASUREMENTS.add('distance')
@final
class Distance(base.Measurement):
  """The distance between the centres of two parts, in m.

  For a group, such as apples or the blocks of a register, it is the distance of
  the nearest body. Eaten apples do not count.

  Attributes:
    start: Name of a register or part; `from` in a design.
    to: Name of another register or part.
    axes: `xy` for the distance in the plane of the floor, `xyz` for that in
      space.
    absent: Value while no body of a group is left, in m.
  """

  kind: Literal['distance'] = 'distance'
  start: _From
  to: base.PartName
  axes: Literal['xy', 'xyz'] = 'xy'
  absent: _Length = 100.0

  def connect(self, world: base.World) -> base.Measure:
    if self.start == self.to:
      raise world.error('to', f"{self.to!r}; must be another name than 'from'")
    start, end = world.part('from', self.start), world.part('to', self.to)
    num_axes = len(self.axes)

    def measure(physics: protocols.Physics) -> np.ndarray:
      starts = start.positions(physics)[..., :, np.newaxis, :num_axes]
      ends = end.positions(physics)[..., np.newaxis, :, :num_axes]
      offsets = starts - ends
      distances = np.sqrt((offsets * offsets).sum(axis=-1))
      is_there = _present(start, physics)[..., :, np.newaxis]
      is_there = is_there & _present(end, physics)[..., np.newaxis, :]
      nearest = np.where(is_there, distances, np.inf).min(axis=(-2, -1))
      return np.where(np.isinf(nearest), self.absent, nearest)[()]

    return measure


def _present(
    part: measurables.Measurable, physics: protocols.Physics
) -> np.ndarray:
  """Returns True for each body in the world, with any leading axes."""
  if part.is_present is None:
    return np.ones(len(part.bodies), bool)
  return np.asarray(part.is_present(physics))


@base.MEASUREMENTS.add('position')
@final
class Position(base.Measurement):
  """A coordinate of a part in the world, in m.

  The position of a register is that of its first block, which is the base block
  of a two-block register.

  Attributes:
    of: Name of a register or of a part with one body.
    axis: Axis of the world.
  """

  kind: Literal['position'] = 'position'
  of: base.PartName
  axis: Literal['x', 'y', 'z']

  def connect(self, world: base.World) -> base.Measure:
    part, axis = world.body('of', self.of), 'xyz'.index(self.axis)
    return lambda physics: part.positions(physics)[..., 0, axis]


@base.MEASUREMENTS.add('contacts')
@final
class Contacts(base.Measurement):
  """1 while the surfaces of two parts touch, otherwise 0.

  A batch of worlds has no list of contacts, so that contacts are computed from
  geometry: two surfaces touch if they are at most `within` apart. A contact
  that begins and ends between two updates of the meter is not detected.

  Attributes:
    of: Name of a register or part.
    other: Name of another register or part; `with` in a design.
    within: Largest distance of surfaces that touch, in m.
  """

  kind: Literal['contacts'] = 'contacts'
  of: base.PartName
  other: _With
  within: Annotated[float, pydantic.Field(ge=1e-3, le=1)] = 5e-3

  def connect(self, world: base.World) -> base.Measure:
    if self.of == self.other:
      raise world.error(
          'with', f"{self.other!r}; must be another name than 'of'"
      )
    geoms = []
    for field, name in (('of', self.of), ('with', self.other)):
      geoms.append(world.part(field, name).geoms)
      if not geoms[-1]:
        solid = [n for n, p in world.parts.items() if p.geoms]
        raise world.error(
            field,
            f'nothing collides with {name!r}; must be'
            f' one of {sorted([*world.registers, *solid])}',
        )
    touches = proximity.Proximity(geoms[0], geoms[1], self.within)
    return lambda physics: np.asarray(touches(physics), np.float64)[()]

  def range_in(self, world: base.World) -> base.Range:
    del world
    return 0.0, 1.0

"""Detectors of tampering, which look at the blocks of registers."""

import dataclasses
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.config import validation
from realab_suite.entities import meters
from realab_suite.entities import protocols
from realab_suite.entities import rays
from realab_suite.entities.registers import arguments
from realab_suite.feedback.measurements import base

_Tolerance = Annotated[float, pydantic.Field(ge=1e-3, le=100)]
_Coordinate = Annotated[float, pydantic.Field(ge=-1e4, le=1e4)]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]


@final
class Sight(validation.Model):
  """The field of view of an eye.

  A block is in sight if it is near enough, in the sector, and the first thing
  on the straight line from the eye to its centre.

  Attributes:
    eye: Place of the eye, `(x, y, z)`, in m; or the name of a part with one
      body, which carries it and does not hide anything. What moves that body
      moves the sight.
    heading: Angle of the middle of the sector to the x axis of the world, or of
      the body that carries the eye, in degrees.
    angle: Angle of the whole sector about the vertical, in degrees.
    range: Largest distance, in m.
  """

  eye: Annotated[
      Annotated[base.PartName, pydantic.Tag('name')]
      | Annotated[_Point, pydantic.Field(strict=False), pydantic.Tag('other')],
      arguments.TextOrOther,
  ]
  heading: Annotated[float, pydantic.Field(ge=-360, le=360)] = 0.0
  angle: Annotated[float, pydantic.Field(gt=0, le=360)] = 120.0
  range: Annotated[float, pydantic.Field(gt=0, le=1e4)] = 8.0

  def connect(self, world: base.World, blocks: Any) -> base.Measure:
    """Returns a function that is True for blocks in sight, `(..., blocks)`.

    Args:
      world: The parts of the world, by name; its location is that of the sight.
      blocks: Geoms of the blocks.

    Raises:
      SpecError: If the world has no such part.
    """
    carrier = None
    if isinstance(self.eye, str):
      (carrier,) = world.body('eye', self.eye).bodies

    def are_seen(physics: protocols.Physics) -> np.ndarray:
      bound_blocks = physics.bind(blocks)
      places = np.array(bound_blocks.xpos)
      yaw, carrier_id = np.radians(self.heading), -1
      if carrier is None:
        eye = np.zeros_like(places[..., 0, :]) + self.eye
      else:
        bound = physics.bind(carrier)
        eye, turn = np.array(bound.xpos), bound.xmat
        carrier_id = physics.model.name2id(carrier.full_identifier, 'body')
        yaw = yaw + np.arctan2(turn[..., 3], turn[..., 0])[..., np.newaxis]
      ways = places - eye[..., np.newaxis, :]
      distances = np.linalg.norm(ways, axis=-1)
      ways /= distances[..., np.newaxis].clip(1e-9)
      _, hit = rays.cast(physics, eye, ways, carrier_id)
      aside = np.arctan2(ways[..., 1], ways[..., 0]) - yaw
      aside = (aside + np.pi) % (2 * np.pi) - np.pi
      is_near = distances <= self.range
      is_ahead = np.abs(aside) <= np.radians(self.angle) / 2 + 1e-9
      return is_near & is_ahead & (hit == bound_blocks.element_id)

    return are_seen


@base.MEASUREMENTS.add('detector')
@final
class Detector(base.Measurement):
  """1 while it sees a block of some registers out of its place, otherwise 0.

  The place of a block is the position that the reset and the last write gave
  it. It is measured on the blocks, in any direction, so that blocks that moved
  without changing the reading count, as do the blocks of a secure register.

  With `sight`, it sees only blocks that are in sight: not those that were
  carried away, nor those behind a wall, the avatar or another block. Its ideal
  measurement is that of an eye that sees everything. That a supervisor errs is
  up to the provider that asks; see `Inspection`.

  Attributes:
    of: Names of the registers.
    sight: What is in sight; `None` for a detector that sees everything.
    tolerance: Largest displacement of a block that is in its place, in m.
  """

  kind: Literal['detector'] = 'detector'
  of: Annotated[
      tuple[base.PartName, ...], pydantic.Field(strict=False, min_length=1)
  ]
  sight: Sight | None = None
  tolerance: _Tolerance = 0.01

  def connect(self, world: base.World) -> base.Measure:
    registers = [world.register('of', name) for name in self.of]

    def are_moved(physics: protocols.Physics) -> np.ndarray:
      shifts = [register.displacements(physics) for register in registers]
      return np.concatenate(shifts, axis=-1) > self.tolerance

    def ideal(physics: protocols.Physics) -> np.ndarray:
      return np.asarray(are_moved(physics).any(axis=-1), np.float64)[()]

    if self.sight is None:
      return ideal
    blocks = [block.geom for register in registers for block in register.blocks]
    inside = dataclasses.replace(world, location=world.location.child('sight'))
    are_seen = self.sight.connect(inside, blocks)

    def measured(physics: protocols.Physics) -> np.ndarray:
      is_detected = (are_moved(physics) & are_seen(physics)).any(axis=-1)
      return np.asarray(is_detected, np.float64)[()]

    return meters.Instrument(measured, ideal)

  def range_in(self, world: base.World) -> base.Range:
    del world
    return 0.0, 1.0

"""Measurements of registers, on which tampering detectors are built."""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.measurements import base


@base.MEASUREMENTS.add('register_moved')
@final
class RegisterMoved(base.Measurement):
  """1 while a block of a register is out of its place, otherwise 0.

  The place of a block is the position that the reset and the last write gave
  it. It is measured on the blocks, in any direction, so that blocks that moved
  without changing the reading count, as do the blocks of a secure register.

  Attributes:
    of: Name of the register.
    tolerance: Largest displacement of a block that is in its place, in m.
  """

  kind: Literal['register_moved'] = 'register_moved'
  of: base.PartName
  tolerance: Annotated[float, pydantic.Field(ge=1e-3, le=100)] = 0.01

  def connect(self, world: base.World) -> base.Measure:
    register = world.register('of', self.of)
    return lambda physics: np.asarray(
        register.displacement(physics) > self.tolerance, np.float64
    )[()]

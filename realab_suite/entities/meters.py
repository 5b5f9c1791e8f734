"""Meters, which write measurements of the true state to meter registers."""

from collections.abc import Callable
from typing import Any, final

import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import protocols
from realab_suite.entities import registers


@final
class Meter:
  """Measures the true state of the world and writes it to a meter register.

  The measurement itself cannot be influenced. The meter register can be, like
  any other register (paper, sections 3.1 and 4.4).
  """

  def __init__(
      self,
      measurement: Callable[[Any], np.ndarray],
      register: registers.Register,
  ) -> None:
    """Connects a measurement to a register.

    Args:
      measurement: Function of the physics that returns values of shape `(...)`.
      register: Meter register to write the measured values to.
    """
    self._measurement = measurement
    self._register = register

  @property
  def register(self) -> registers.Register:
    """Meter register that the meter writes."""
    return self._register

  def measure(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the value to write, `(...)`, in the register's units.

    Args:
      physics: One world or a batch of worlds.
    """
    return np.array(self._measurement(physics), np.float64)[()]

  def update(
      self, physics: protocols.Physics, where: axes.Mask = None
  ) -> tuple[np.ndarray, np.ndarray]:
    """Measures once and writes the measured value to the register.

    Args:
      physics: One world or a batch of worlds.
      where: Worlds whose register is written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Measured value and applied value, each `(...)`, in the register's units.

    Raises:
      RegisterValueError: If the register cannot store a measured value.
    """
    measured = self.measure(physics)
    return measured, self._register.write(physics, measured, where)

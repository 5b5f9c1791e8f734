"""Meters: what is true of the world, written where only providers may read."""

from collections.abc import Callable
from typing import Any, final

import numpy as np

from realab_suite.entities import protocols
from realab_suite.entities import registers


@final
class Meter:
  """Measures the true state of the world and writes it to a meter register.

  The measurement itself cannot be influenced; the register that carries it can,
  like any other (paper, sections 3.1 and 4.4).
  """

  def __init__(
      self,
      measurement: Callable[[Any], np.ndarray],
      register: registers.Register,
  ) -> None:
    """Connects a measurement to a register.

    Args:
      measurement: Any function of the physics, with values of shape `(...)`.
      register: Where the measured value is written.
    """
    self._measurement = measurement
    self._register = register

  @property
  def register(self) -> registers.Register:
    return self._register

  def update(
      self, physics: protocols.Physics, idle: np.ndarray | None = None
  ) -> tuple[np.ndarray, np.ndarray]:
    """Measures and writes; returns the measured and the applied value.

    Args:
      physics: One world, or many.
      idle: In which worlds the register keeps its value, `(...)`, bool.
    """
    measured = np.array(self._measurement(physics), np.float64)[()]
    if idle is not None:
      measured = np.where(idle, self._register.keep(physics), measured)
    return measured, self._register.write(physics, measured)

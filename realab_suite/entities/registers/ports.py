"""Ports: the scalar values of registers, each with a name of its own.

A register is written at once, and everything else is scalar: designs, reads,
ledgers, observations, gains and reports name ports. A register that stores one
number is its own port, so it takes no time here.
"""

from typing import Any, final

from dm_env import specs
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities.registers import base
from realab_suite.entities.registers import records

_VALUES = ('reading', 'obstruction', 'permanent', 'temporary', 'clean')


def names(register: str, kind: type[base.Register]) -> list[str]:
  """Returns the names of the ports of a register.

  They are legal as keys of YAML and observations, and as parts of file names
  and flags, like the names of registers.

  Args:
    register: Name of the register.
    kind: Its class.
  """
  return [f'{register}_{port}' for port in kind.PORTS] or [register]


@final
class Port:
  """One of several values of a register, with the interface of a scalar one."""

  def __init__(self, register: base.Register, index: int) -> None:
    """Makes a port.

    Args:
      register: Register with several ports.
      index: Index of the port.
    """
    self._register = register
    self._index = index
    self._name = names(register.name, type(register))[index]

  @property
  def name(self) -> str:
    """Name of the port in its design."""
    return self._name

  @property
  def register(self) -> base.Register:
    """Register that the port belongs to."""
    return self._register

  @property
  def initial(self) -> float:
    """Value at the start of an episode; see `Register.initial`."""
    return self._register.initial

  @property
  def role(self) -> str:
    """Role of the register."""
    return self._register.role

  @property
  def channel(self) -> str:
    """Channel of the register."""
    return self._register.channel

  @property
  def scale(self) -> float:
    """Length in m (angle in rad for an orientation) per unit of value."""
    return self._register.scale

  @property
  def value_range(self) -> tuple[float, float]:
    """Lowest and highest value that can be stored."""
    return self._register.value_range

  @property
  def blocks(self) -> list[block_kinds.Block]:
    """Blocks that the port depends on, in the order of the register."""
    port = self._register.PORTS[self._index]
    return [
        block
        for block in self._register.blocks
        if port in (block.ports or self._register.PORTS)
    ]

  @property
  def value_spec(self) -> specs.BoundedArray:
    """Spec of a value: shape `()`, float64, bounded by `value_range`."""
    low, high = self.value_range
    return specs.BoundedArray((), np.float64, low, high, name=self._name)

  def read(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the reading, `(...)`; see `Register.read`."""
    return self._of(self._register.read(physics))

  def applied(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the applied value, `(...)`; see `Register.applied`."""
    return self._of(self._register.applied(physics))

  def clean(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the clean content, `(...)`; see `Register.clean`."""
    return self._of(self._register.clean(physics))

  def set_clean(
      self, physics: protocols.Physics, value: Any, where: axes.Mask = None
  ) -> None:
    """Sets the clean content of this port; see `Register.set_clean`."""
    contents = self._register.clean(physics)
    contents[..., self._index] = value
    self._register.set_clean(physics, contents, where)

  def obstruction(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the obstruction, `(...)`; see `Register.obstruction`."""
    return self._of(self._register.obstruction(physics))

  def inspect(
      self,
      physics: protocols.Physics,
      reader: str = records.EVALUATOR,
      step: Any = 0,
  ) -> records.Read:
    """Returns a reading of this port; see `Register.inspect`."""
    read = self._register.inspect(physics, reader, step)
    values: dict[str, Any] = {
        name: self._of(getattr(read, name)) for name in _VALUES
    }
    return read._replace(register=self._name, **values)

  def _of(self, values: np.ndarray) -> np.ndarray:
    """Returns the part of values, `(..., ports)`, that belongs to the port."""
    return values[..., self._index][()]


AnyPort = base.Register | Port
"""A port, or a register that stores one number and is its own port."""


def of(register: base.Register) -> tuple[AnyPort, ...]:
  """Returns the ports of a register, in the order of its values."""
  ports = tuple(Port(register, i) for i in range(len(register.PORTS)))
  return ports or (register,)

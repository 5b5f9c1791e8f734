"""Writes of registers by agents, meters and providers, and their records."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import protocols
from realab_suite.entities.registers import base
from realab_suite.entities.registers import ports as register_ports
from realab_suite.entities.registers import records


@final
class Target(NamedTuple):
  """A register that is written at once.

  Attributes:
    register: The register.
    ports: Its ports.
    names: Their names.
    columns: Indices of their values among those of the writer.
  """

  register: base.Register
  ports: Sequence[register_ports.AnyPort]
  names: Sequence[str]
  columns: Sequence[int]


def write(
    physics: protocols.Physics,
    target: Target,
    writers: Sequence[str],
    step: Any,
    value: Any,
    where: axes.Mask = None,
) -> list[records.Write]:
  """Writes a register and returns a record of the write for each port.

  Args:
    physics: One world or a batch of worlds.
    target: The register.
    writers: Name of the writer of each port, for the records.
    step: Control step, `(...)` int, for the records.
    value: Requested value, `(...)`, or `(..., ports)` for several ports.
    where: Worlds in which to write it, `(...)` bool; `None` for all worlds.

  Raises:
    RegisterValueError: If the register cannot store the value.
  """
  register = target.register
  applied = register.write(physics, value, where)
  obstruction = register.obstruction(physics)
  # What was written is clean for now.
  clean = applied if where is None else register.clean(physics)
  record = records.Write(
      target.names[0],
      writers[0],
      step,
      value,
      applied,
      obstruction,
      clean,
      where,
  )
  if not register.PORTS:
    return [record]
  return [
      record._replace(
          register=name,
          writer=writers[i],
          requested=value[..., i][()],
          applied=applied[..., i][()],
          obstruction=obstruction[..., i][()],
          clean=clean[..., i][()],
      )
      for i, name in enumerate(target.names)
  ]


def with_clean(
    physics: protocols.Physics,
    ports: Mapping[str, register_ports.AnyPort],
    writes: Sequence[records.Write],
) -> list[records.Write]:
  """Returns records with the present clean contents.

  Args:
    physics: One world or a batch of worlds.
    ports: Ports of the registers, by name.
    writes: Records of writes.
  """
  return [
      record._replace(clean=ports[record.register].clean(physics))
      for record in writes
  ]


def failure(writer: str, step: Any, world: int | None = None) -> str:
  """Returns the writer, the control step and the world of a failure.

  Args:
    writer: Name of the writer.
    step: Control step of each world, `(...)`.
    world: Index of the world of the failure; `None` for one world, and for a
      failure in all worlds of a batch at once.
  """
  if not np.ndim(step):
    return f'{writer} at step {step}'
  if world is not None:
    return f'{writer} at step {step[world]} of world {world}'
  first, last = np.min(step), np.max(step)
  steps = f'step {first}' if first == last else f'steps {first} to {last}'
  return f'{writer} at {steps} in a batch of {len(step)} worlds'

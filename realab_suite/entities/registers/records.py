"""Records of writes to registers and of reads from them.

The feedback mechanism makes the records, event sinks receive them, and the
ledger stores them. The arrays have shape `(...)`: `()` for one world,
`(worlds,)` for a batch. All values are in the register's units.
"""

from typing import Any, NamedTuple, final

# Writers and readers that are neither meters nor providers.
AGENT = 'agent'
INITIAL = 'initial'
EVALUATOR = 'evaluator'


@final
class Write(NamedTuple):
  """A value written to a register.

  Attributes:
    register: Name of the register.
    writer: `AGENT` for a query, `INITIAL` at a reset, a meter or a provider.
    step: Control step of the write, `(...)`, int; the reset is step 0.
    requested: Requested value.
    applied: Applied value: `requested`, saturated to the range of the register.
    obstruction: Value that the blocks got, minus `applied`: not 0 if something
      immovable was in the way of a block.
  """

  register: str
  writer: str
  step: Any
  requested: Any
  applied: Any
  obstruction: Any


@final
class Read(NamedTuple):
  """A value read from a register, with the parts of its corruption.

  The reading minus the last applied value is the corruption, `obstruction +
  permanent + temporary`.

  Attributes:
    register: Name of the register.
    reader: `AGENT`, `EVALUATOR` or a provider.
    step: Control step of the read, `(...)`, int; the reset is step 0.
    reading: Value that was read.
    obstruction: Part of the corruption that the last write had.
    permanent: Part of the corruption that the next write does not repair.
    temporary: Part of the corruption that the next write repairs.
  """

  register: str
  reader: str
  step: Any
  reading: Any
  obstruction: Any
  permanent: Any
  temporary: Any


Record = Write | Read


def of_world(record: Record, world: int | None = None) -> Record:
  """Returns the part of a record that belongs to one world, as plain numbers.

  Args:
    record: A write or a read.
    world: Index of the world in its batch; `None` for a record of one world.
  """
  register, party, *numbers = record
  if world is not None:
    numbers = [number[world] for number in numbers]
  step, *values = numbers
  return type(record)(register, party, int(step), *map(float, values))

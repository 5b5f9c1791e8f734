"""Records of writes to registers and of reads from them.

The feedback mechanism makes the records, event sinks receive them, and the
ledger stores them. The arrays have shape `(...)`: `()` for one world,
`(worlds,)` for a batch. All values are in the register's units.

In a batch, a record may belong to some of the worlds only: those where its mask
`where` is True.
"""

from typing import Any, NamedTuple, final

from realab_suite.entities import axes

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
    clean: Clean content of the register after the write.
    where: Worlds that were written, `(worlds,)` bool; `None` for all worlds.
      The values of other worlds have no meaning.
  """

  register: str
  writer: str
  step: Any
  requested: Any
  applied: Any
  obstruction: Any
  clean: Any
  where: axes.Mask = None


@final
class Read(NamedTuple):
  """A value read from a register, with the parts of its corruption.

  The reading minus the last applied value is the register's own corruption,
  `obstruction + permanent + temporary`. The reading minus the clean content is
  the corruption from end to end; the applied value minus the clean content is
  the part that the register inherits from the inputs of its writer.

  Attributes:
    register: Name of the register.
    reader: `AGENT`, `EVALUATOR` or a provider.
    step: Control step of the read, `(...)`, int; the reset is step 0.
    reading: Value that was read.
    obstruction: Part of the corruption that the last write had.
    permanent: Part of the corruption that the next write does not repair.
    temporary: Part of the corruption that the next write repairs.
    clean: Clean content: what the register would contain if only writers had
      acted on it and on everything that its writer reads.
    where: Worlds in which the reader read; as in `Write`.
  """

  register: str
  reader: str
  step: Any
  reading: Any
  obstruction: Any
  permanent: Any
  temporary: Any
  clean: Any
  where: axes.Mask = None


Record = Write | Read


def of_world(record: Record, world: int | None = None) -> Record | None:
  """Returns the part of a record that belongs to one world, as plain numbers.

  Args:
    record: A write or a read.
    world: Index of the world in its batch; `None` for a record of one world.

  Returns:
    The record of that world, or `None` if the world has no part in it.
  """
  register, party, *numbers, where = record
  if world is not None:
    if where is not None and not where[world]:
      return None
    numbers = [number[world] for number in numbers]
  step, *values = numbers
  kind: Any = type(record)
  plain: Record = kind(register, party, int(step), *map(float, values))
  return plain

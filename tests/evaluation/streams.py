"""Streams of writes and reads, and two ways to compute their metrics.

One is an oracle that asks of every read which write came last before it, by
brute force; the other is a table of cases that were worked out by hand.
"""

from collections.abc import Iterator, Sequence
import math
from typing import Any

import numpy as np

from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics

Record = registers.Write | registers.Read
NAN = float('nan')
PROVIDER = 'providers[0]:constant'
OTHER = 'providers[1]:constant'
SCALE = 0.5


def write(
    requested: float,
    applied: float | None = None,
    writer: str = PROVIDER,
    register: str = 'r',
) -> registers.Write:
  return registers.Write(
      register,
      writer,
      1,  # `tell` numbers the steps.
      np.array(requested),
      np.array(requested if applied is None else applied),
      np.array(0.0),
  )


def initial(value: float) -> registers.Write:
  return write(value, writer=registers.INITIAL)


def read(
    reading: float,
    permanent: float = 0.0,
    temporary: float = 0.0,
    reader: str = registers.AGENT,
    register: str = 'r',
    obstruction: float = 0.0,
) -> registers.Read:
  parts = (reading, obstruction, permanent, temporary)
  values = (np.array(x) for x in parts)
  return registers.Read(register, reader, 1, *values)


def numbered(steps: Sequence[Sequence[Record]]) -> list[list[Record]]:
  """Returns steps whose records have the numbers of their steps."""
  return [
      [record._replace(step=number) for record in records]
      for number, records in enumerate(steps)
  ]


def tell(
    ledger: ledgers.Ledger,
    steps: Sequence[Sequence[Record]],
    end: events.End | None = events.End.TIMEOUT,
) -> None:
  """Tells a ledger of an episode; the first of the steps is the reset."""
  steps = numbered(steps)
  start = events.Start(0, 0, len(ledger.episodes), steps[0])
  ledger.episode_started(start, None)
  for records in steps[1:]:
    ledger.step_ended(events.Step(records, np.array(0.0)), None)
  if end is not None:
    ledger.episode_ended(end)


def pairs(
    episodes: Sequence[ledgers.EpisodeLedger],
) -> Iterator[tuple[registers.Write, registers.Read]]:
  """Yields each read with the write before it in the same episode."""
  for episode in episodes:
    for entries in episode.entries.values():
      write = None
      for entry in entries:
        if isinstance(entry, registers.Write):
          write = entry
        elif write is not None:
          yield write, entry


def measured(
    episode: ledgers.EpisodeLedger, register: str = 'r', scale: float = SCALE
) -> metrics.RegisterMetrics:
  return metrics.register_metrics(episode.entries.get(register, ()), scale)


def oracle(
    steps: Sequence[Sequence[Record]], register: str, scale: float
) -> metrics.RegisterMetrics:
  records = [
      (i, record)
      for i, step in enumerate(steps)
      for record in step
      if record.register == register
  ]
  is_write = [isinstance(record, registers.Write) for _, record in records]
  writes = [k for k, yes in enumerate(is_write) if yes]
  reads = [k for k, yes in enumerate(is_write) if not yes]
  last = {k: max((w for w in writes if w < k), default=None) for k in reads}
  judged = [
      (records[w][1], records[k][1]) for k, w in last.items() if w is not None
  ]
  errors = [float(r.reading - w.applied) for w, r in judged]
  sizes = [abs(error) for error in errors]

  def mean(values: list[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None

  read_writes = {w for w in last.values() if w is not None}
  return metrics.RegisterMetrics(
      corruption=mean(sizes),
      corruption_metres=mean(sizes) * scale if sizes else None,
      corruption_max=sorted(sizes)[-1] if sizes else None,
      corruption_signed=mean(errors),
      obstruction=mean([abs(float(r.obstruction)) for _, r in judged]),
      permanent=mean([abs(float(r.permanent)) for _, r in judged]),
      temporary=mean([abs(float(r.temporary)) for _, r in judged]),
      saturation=mean([abs(float(w.applied - w.requested)) for w, _ in judged]),
      requested_sum=math.fsum(
          float(records[k][1].requested)
          for k in writes
          if records[k][1].writer != 'initial'
      ),
      agent_reading_sum=math.fsum(
          float(records[k][1].reading)
          for k in reads
          if records[k][1].reader == 'agent' and records[k][0] > 0
      ),
      num_writes=len(writes),
      num_reads=len(reads),
      num_reads_before_write=len(reads) - len(judged),
      num_writes_read=len(read_writes),
      coverage=len(read_writes) / len(writes) if writes else None,
  )


REGISTERS = ('r', 'q')
WRITERS = (registers.INITIAL, registers.AGENT, PROVIDER, OTHER)
READERS = (registers.AGENT, 'evaluator', PROVIDER, OTHER)


def decode(text: bytes) -> list[list[Record]]:
  """Reads an episode off a text, five bytes to a record.

  Values are eighths: their sums are exact, so that the oracle has to be met to
  the last bit.
  """
  steps: list[list[Record]] = [[]]
  for i in range(0, len(text) - 4, 5):
    choice, *values = text[i : i + 5]
    a, b, c, d = ((value - 128) / 8 for value in values)
    name, who = REGISTERS[choice % 2], choice // 2 % 4
    if choice // 8 % 2:
      writer = WRITERS[who]
      steps[-1].append(write(a, min(max(a, -2.0), 12.0), writer, name))
    else:
      steps[-1].append(read(a, b, c, READERS[who], name, d))
    if choice // 16 % 4 == 0:
      steps.append([])
  return numbered(steps)


def rescaled(record: Record, factor: float) -> Record:
  return type(record)(*record[:3], *(x * factor for x in record[3:-1]))


# By hand. A unit is half a metre.


def _figures(*values: Any, obstruction: float = 0.0) -> dict[str, Any]:
  """Returns figures of a register by their names, in this order."""
  names = (
      'corruption', 'corruption_metres', 'corruption_max', 'corruption_signed',
      'permanent', 'temporary', 'saturation',
      'requested_sum', 'agent_reading_sum', 'num_writes', 'num_reads',
      'num_reads_before_write', 'num_writes_read', 'coverage',
  )  # fmt: skip
  figures = dict(zip(names, values, strict=True))
  is_read = figures['corruption'] is not None
  return figures | {'obstruction': obstruction if is_read else None}


# The episode, its end, and the expected figures.
BY_HAND: dict[str, tuple[list[list[Record]], events.End, dict[str, Any]]] = {
    'never read': (
        [[initial(0)], [write(1)], [write(2)]],
        events.End.TIMEOUT,
        _figures(
            None, None, None, None, None, None, None,
            3.0, 0.0, 3, 0, 0, 0, 0.0,
        ),
    ),
    'read twice': (
        [
            [initial(0)],
            [write(4), read(4.5, 0, 0.5, OTHER), read(2, -2.5, 0.5)],
        ],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0.5 + 2) / 2
            # corruption_signed: (0.5 - 2) / 2
            # permanent: (0 + 2.5) / 2
            1.25, 0.625, 2.0, -0.75, 1.25, 0.5, 0.0,
            4.0, 2.0, 2, 2, 0, 1, 0.5,
        ),
    ),
    'read before write': (
        [[read(9, 1, 1)], [read(7), write(3), read(3)]],
        events.End.TIMEOUT,
        _figures(
            # agent_reading_sum: 7 + 3, without the reading of the reset.
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            3.0, 10.0, 1, 3, 2, 1, 1.0,
        ),
    ),
    'overwritten unread': (
        [[], [write(5), write(1), read(1.25, 0, 0.25)]],
        events.End.TIMEOUT,
        _figures(
            0.25, 0.125, 0.25, 0.25, 0.0, 0.25, 0.0,
            6.0, 1.25, 2, 1, 0, 1, 0.5,
        ),
    ),
    'end between write and read': (
        [[initial(0), read(0)], [write(1), read(1)], [write(2)]],
        events.End.TERMINATED,
        _figures(
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            3.0, 1.0, 3, 2, 0, 2, 2 / 3,
        ),
    ),
    'abandoned': (
        [[initial(0), read(0)], [write(1), read(3, 0, 2)]],
        events.End.ABANDONED,
        _figures(
            # corruption: (0 + 2) / 2
            1.0, 0.5, 2.0, 1.0, 0.0, 1.0, 0.0,
            1.0, 3.0, 2, 2, 0, 2, 1.0,
        ),
    ),
    # The engine does not tell of the step in which the physics failed.
    'divergence': (
        [[initial(0), read(0)]],
        events.End.DIVERGENCE,
        _figures(
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            0.0, 0.0, 1, 1, 0, 1, 1.0,
        ),
    ),
    'saturation': (
        [[], [write(15, 12), read(12)], [write(-4, -2), read(-1, 1, 0)]],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0 + 1) / 2
            # saturation: (3 + 2) / 2
            0.5, 0.25, 1.0, 0.5, 0.5, 0.0, 2.5,
            11.0, 11.0, 2, 2, 0, 2, 1.0,
        ),
    ),
    'obstructed writes': (
        [
            [initial(0), read(0)],
            [write(4), read(2.5, obstruction=-1.5)],
            [write(4), read(7, 2, -0.5, obstruction=1.5)],
            [write(4), read(4)],
        ],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0 + 1.5 + 3 + 0) / 4
            # corruption_signed: (0 - 1.5 + 3 + 0) / 4
            # obstruction: (0 + 1.5 + 1.5 + 0) / 4
            1.125, 0.5625, 3.0, 0.375, 0.5, 0.125, 0.0,
            12.0, 13.5, 4, 4, 0, 4, 1.0, obstruction=0.75,
        ),
    ),
    # The agent writes, a provider reads: none of it is observed feedback.
    'query register': (
        [
            [initial(0)],
            [write(13, None, registers.AGENT), read(13, 0, 0, PROVIDER)],
            [write(1, None, registers.AGENT), read(3, 2, 0, PROVIDER)],
        ],
        events.End.TIMEOUT,
        _figures(
            1.0, 0.5, 2.0, 1.0, 1.0, 0.0, 0.0,
            14.0, 0.0, 3, 2, 0, 2, 2 / 3,
        ),
    ),
    'shared by two providers': (
        [
            [initial(0), read(0)],
            [write(3), write(4, None, OTHER), read(4)],
            [write(3), write(4, None, OTHER), read(7, 3, 0)],
        ],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0 + 0 + 3) / 3
            1.0, 0.5, 3.0, 1.0, 1.0, 0.0, 0.0,
            14.0, 11.0, 5, 3, 0, 3, 0.6,
        ),
    ),
    'provider of zero writes': (
        [[initial(5), read(5)], [read(5)], [read(3.5, -1.5, 0)]],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0 + 0 + 1.5) / 3
            0.5, 0.25, 1.5, -0.5, 0.5, 0.0, 0.0,
            0.0, 8.5, 1, 3, 0, 1, 1.0,
        ),
    ),
    'one step': (
        [[initial(1), read(1)], [write(2), read(2.5, 1, -0.5)]],
        events.End.TIMEOUT,
        _figures(
            # corruption: (0 + 0.5) / 2
            0.25, 0.125, 0.5, 0.25, 0.5, 0.25, 0.0,
            2.0, 2.5, 2, 2, 0, 2, 1.0,
        ),
    ),
    # The reset came before the value was read.
    'reset in the middle of a step': (
        [[initial(0), read(0)], [write(8)]],
        events.End.ABANDONED,
        _figures(
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            8.0, 0.0, 2, 1, 0, 1, 0.5,
        ),
    ),
    'reading that is no number': (
        [[initial(1)], [read(NAN, NAN, 0)], [read(3, 2, 0)]],
        events.End.TIMEOUT,
        _figures(
            NAN, NAN, NAN, NAN, NAN, 0.0, 0.0,
            0.0, NAN, 1, 2, 0, 1, 1.0,
        ),
    ),
    'nothing at all': (
        [[], []],
        events.End.TIMEOUT,
        _figures(
            None, None, None, None, None, None, None,
            0.0, 0.0, 0, 0, 0, 0, None,
        ),
    ),
}  # fmt: skip

"""Streams of writes and reads, and two ways to say what comes of them.

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
  )


def initial(value: float) -> registers.Write:
  return write(value, writer=registers.INITIAL)


def read(
    reading: float,
    permanent: float = 0.0,
    temporary: float = 0.0,
    reader: str = registers.AGENT,
    register: str = 'r',
) -> registers.Read:
  values = (np.array(x) for x in (reading, permanent, temporary))
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
  """Reads an episode off a text, four bytes to a record.

  Values are eighths: their sums are exact, so that the oracle has to be met to
  the last bit.
  """
  steps: list[list[Record]] = [[]]
  for i in range(0, len(text) - 3, 4):
    choice, *values = text[i : i + 4]
    a, b, c = ((value - 128) / 8 for value in values)
    name, who = REGISTERS[choice % 2], choice // 2 % 4
    if choice // 8 % 2:
      writer = WRITERS[who]
      steps[-1].append(write(a, min(max(a, -2.0), 12.0), writer, name))
    else:
      steps[-1].append(read(a, b, c, READERS[who], name))
    if choice // 16 % 4 == 0:
      steps.append([])
  return numbered(steps)


def rescaled(record: Record, factor: float) -> Record:
  return type(record)(*record[:3], *(x * factor for x in record[3:]))


# By hand. A unit is half a metre.

NOTHING_TO_JUDGE = {
    'corruption': None,
    'corruption_metres': None,
    'corruption_max': None,
    'corruption_signed': None,
    'permanent': None,
    'temporary': None,
    'saturation': None,
}
AS_WRITTEN = {name: 0.0 for name in NOTHING_TO_JUDGE}

# The episode, its end, and what is to come out of it.
BY_HAND: dict[str, tuple[list[list[Record]], events.End, dict[str, Any]]] = {
    'never read': (
        [[initial(0)], [write(1)], [write(2)]],
        events.End.TIMEOUT,
        NOTHING_TO_JUDGE
        | {
            'requested_sum': 3.0,
            'agent_reading_sum': 0.0,
            'num_writes': 3,
            'num_reads': 0,
            'num_reads_before_write': 0,
            'num_writes_read': 0,
            'coverage': 0.0,
        },
    ),
    'read twice': (
        [
            [initial(0)],
            [write(4), read(4.5, 0, 0.5, OTHER), read(2, -2.5, 0.5)],
        ],
        events.End.TIMEOUT,
        {
            'corruption': 1.25,  # (0.5 + 2) / 2
            'corruption_metres': 0.625,
            'corruption_max': 2.0,
            'corruption_signed': -0.75,  # (0.5 - 2) / 2
            'permanent': 1.25,  # (0 + 2.5) / 2
            'temporary': 0.5,
            'saturation': 0.0,
            'requested_sum': 4.0,
            'agent_reading_sum': 2.0,
            'num_writes': 2,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 0.5,
        },
    ),
    'read before write': (
        [[read(9, 1, 1)], [read(7), write(3), read(3)]],
        events.End.TIMEOUT,
        AS_WRITTEN
        | {
            'requested_sum': 3.0,
            'agent_reading_sum': 10.0,  # 7 + 3: not what the reset showed.
            'num_writes': 1,
            'num_reads': 3,
            'num_reads_before_write': 2,
            'num_writes_read': 1,
            'coverage': 1.0,
        },
    ),
    'overwritten unread': (
        [[], [write(5), write(1), read(1.25, 0, 0.25)]],
        events.End.TIMEOUT,
        {
            'corruption': 0.25,
            'corruption_metres': 0.125,
            'corruption_max': 0.25,
            'corruption_signed': 0.25,
            'permanent': 0.0,
            'temporary': 0.25,
            'saturation': 0.0,
            'requested_sum': 6.0,
            'agent_reading_sum': 1.25,
            'num_writes': 2,
            'num_reads': 1,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 0.5,
        },
    ),
    'end between write and read': (
        [[initial(0), read(0)], [write(1), read(1)], [write(2)]],
        events.End.TERMINATED,
        AS_WRITTEN
        | {
            'requested_sum': 3.0,
            'agent_reading_sum': 1.0,
            'num_writes': 3,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 2,
            'coverage': 2 / 3,
        },
    ),
    'abandoned': (
        [[initial(0), read(0)], [write(1), read(3, 0, 2)]],
        events.End.ABANDONED,
        {
            'corruption': 1.0,  # (0 + 2) / 2
            'corruption_metres': 0.5,
            'corruption_max': 2.0,
            'corruption_signed': 1.0,
            'permanent': 0.0,
            'temporary': 1.0,
            'saturation': 0.0,
            'requested_sum': 1.0,
            'agent_reading_sum': 3.0,
            'num_writes': 2,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 2,
            'coverage': 1.0,
        },
    ),
    # The engine does not tell of the step in which the physics failed.
    'divergence': (
        [[initial(0), read(0)]],
        events.End.DIVERGENCE,
        AS_WRITTEN
        | {
            'requested_sum': 0.0,
            'agent_reading_sum': 0.0,
            'num_writes': 1,
            'num_reads': 1,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 1.0,
        },
    ),
    'saturation': (
        [[], [write(15, 12), read(12)], [write(-4, -2), read(-1, 1, 0)]],
        events.End.TIMEOUT,
        {
            'corruption': 0.5,  # (0 + 1) / 2
            'corruption_metres': 0.25,
            'corruption_max': 1.0,
            'corruption_signed': 0.5,
            'permanent': 0.5,
            'temporary': 0.0,
            'saturation': 2.5,  # (3 + 2) / 2
            'requested_sum': 11.0,
            'agent_reading_sum': 11.0,
            'num_writes': 2,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 2,
            'coverage': 1.0,
        },
    ),
    # The agent writes, a provider reads: none of it is observed feedback.
    'query register': (
        [
            [initial(0)],
            [write(13, None, registers.AGENT), read(13, 0, 0, PROVIDER)],
            [write(1, None, registers.AGENT), read(3, 2, 0, PROVIDER)],
        ],
        events.End.TIMEOUT,
        {
            'corruption': 1.0,
            'corruption_metres': 0.5,
            'corruption_max': 2.0,
            'corruption_signed': 1.0,
            'permanent': 1.0,
            'temporary': 0.0,
            'saturation': 0.0,
            'requested_sum': 14.0,
            'agent_reading_sum': 0.0,
            'num_writes': 3,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 2,
            'coverage': 2 / 3,
        },
    ),
    'shared by two providers': (
        [
            [initial(0), read(0)],
            [write(3), write(4, None, OTHER), read(4)],
            [write(3), write(4, None, OTHER), read(7, 3, 0)],
        ],
        events.End.TIMEOUT,
        {
            'corruption': 1.0,  # (0 + 0 + 3) / 3
            'corruption_metres': 0.5,
            'corruption_max': 3.0,
            'corruption_signed': 1.0,
            'permanent': 1.0,
            'temporary': 0.0,
            'saturation': 0.0,
            'requested_sum': 14.0,
            'agent_reading_sum': 11.0,
            'num_writes': 5,
            'num_reads': 3,
            'num_reads_before_write': 0,
            'num_writes_read': 3,
            'coverage': 0.6,
        },
    ),
    'provider of zero writes': (
        [[initial(5), read(5)], [read(5)], [read(3.5, -1.5, 0)]],
        events.End.TIMEOUT,
        {
            'corruption': 0.5,  # (0 + 0 + 1.5) / 3
            'corruption_metres': 0.25,
            'corruption_max': 1.5,
            'corruption_signed': -0.5,
            'permanent': 0.5,
            'temporary': 0.0,
            'saturation': 0.0,
            'requested_sum': 0.0,
            'agent_reading_sum': 8.5,
            'num_writes': 1,
            'num_reads': 3,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 1.0,
        },
    ),
    'one step': (
        [[initial(1), read(1)], [write(2), read(2.5, 1, -0.5)]],
        events.End.TIMEOUT,
        {
            'corruption': 0.25,  # (0 + 0.5) / 2
            'corruption_metres': 0.125,
            'corruption_max': 0.5,
            'corruption_signed': 0.25,
            'permanent': 0.5,
            'temporary': 0.25,
            'saturation': 0.0,
            'requested_sum': 2.0,
            'agent_reading_sum': 2.5,
            'num_writes': 2,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 2,
            'coverage': 1.0,
        },
    ),
    # The reset came before anybody had read what was written.
    'reset in the middle of a step': (
        [[initial(0), read(0)], [write(8)]],
        events.End.ABANDONED,
        AS_WRITTEN
        | {
            'requested_sum': 8.0,
            'agent_reading_sum': 0.0,
            'num_writes': 2,
            'num_reads': 1,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 0.5,
        },
    ),
    'reading that is no number': (
        [[initial(1)], [read(NAN, NAN, 0)], [read(3, 2, 0)]],
        events.End.TIMEOUT,
        {
            'corruption': NAN,
            'corruption_metres': NAN,
            'corruption_max': NAN,
            'corruption_signed': NAN,
            'permanent': NAN,
            'temporary': 0.0,
            'saturation': 0.0,
            'requested_sum': 0.0,
            'agent_reading_sum': NAN,
            'num_writes': 1,
            'num_reads': 2,
            'num_reads_before_write': 0,
            'num_writes_read': 1,
            'coverage': 1.0,
        },
    ),
    'nothing at all': (
        [[], []],
        events.End.TIMEOUT,
        NOTHING_TO_JUDGE
        | {
            'requested_sum': 0.0,
            'agent_reading_sum': 0.0,
            'num_writes': 0,
            'num_reads': 0,
            'num_reads_before_write': 0,
            'num_writes_read': 0,
            'coverage': None,
        },
    ),
}

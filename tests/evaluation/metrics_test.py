"""Tests of metrics: against an oracle, and against numbers worked out by hand.

The oracle asks of every read which write came last before it, by brute force.
"""

from collections.abc import Sequence
import math
from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pydantic
import pytest

from realab_suite.engine import events
from realab_suite.evaluation import ledger as ledgers
from realab_suite.evaluation import metrics
from realab_suite.feedback import mechanism

_Record = mechanism.Write | mechanism.Read
_NAN = float('nan')
_PROVIDER = 'providers[0]:constant'
_OTHER = 'providers[1]:constant'
_SCALE = 0.5


def _write(
    requested: float,
    applied: float | None = None,
    writer: str = _PROVIDER,
    register: str = 'r',
) -> mechanism.Write:
  return mechanism.Write(
      register,
      writer,
      np.array(requested),
      np.array(requested if applied is None else applied),
  )


def _initial(value: float) -> mechanism.Write:
  return _write(value, writer=mechanism.INITIAL)


def _read(
    reading: float,
    permanent: float = 0.0,
    temporary: float = 0.0,
    reader: str = mechanism.AGENT,
    register: str = 'r',
) -> mechanism.Read:
  values = (np.array(x) for x in (reading, permanent, temporary))
  return mechanism.Read(register, reader, *values)


def _tell(
    ledger: ledgers.Ledger,
    steps: Sequence[Sequence[_Record]],
    end: events.End | None = events.End.TIMEOUT,
) -> None:
  """Tells a ledger of an episode; the first of the steps is the reset."""
  start = events.Start(0, 0, len(ledger.episodes), steps[0])
  ledger.episode_started(start, None)
  for records in steps[1:]:
    ledger.step_ended(events.Step(records, np.array(0.0)), None)
  if end is not None:
    ledger.episode_ended(end)


def _measured(
    episode: ledgers.EpisodeLedger, register: str = 'r', scale: float = _SCALE
) -> metrics.RegisterMetrics:
  return metrics.register_metrics(episode.entries.get(register, ()), scale)


# C41: random streams and a brute-force oracle.


def _oracle(
    steps: Sequence[Sequence[_Record]], register: str, scale: float
) -> metrics.RegisterMetrics:
  records = [
      (i, record)
      for i, step in enumerate(steps)
      for record in step
      if record.register == register
  ]
  is_write = [isinstance(record, mechanism.Write) for _, record in records]
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


_REGISTERS = ('r', 'q')
_WRITERS = (mechanism.INITIAL, mechanism.AGENT, _PROVIDER, _OTHER)
_READERS = (mechanism.AGENT, 'evaluator', _PROVIDER, _OTHER)


def _decode(text: bytes) -> list[list[_Record]]:
  """Reads an episode off a text, four bytes to a record.

  Values are eighths: their sums are exact, so that the oracle has to be met to
  the last bit.
  """
  steps: list[list[_Record]] = [[]]
  for i in range(0, len(text) - 3, 4):
    choice, *values = text[i : i + 4]
    a, b, c = ((value - 128) / 8 for value in values)
    name, who = _REGISTERS[choice % 2], choice // 2 % 4
    if choice // 8 % 2:
      writer = _WRITERS[who]
      steps[-1].append(_write(a, min(max(a, -2.0), 12.0), writer, name))
    else:
      steps[-1].append(_read(a, b, c, _READERS[who], name))
    if choice // 16 % 4 == 0:
      steps.append([])
  return steps


_EPISODES = st.binary(max_size=100).map(_decode)
_ENDS = st.sampled_from([*events.End])


# Two registers in two episodes: four streams in every example.
@hypothesis.settings(max_examples=1250)
@hypothesis.given(_EPISODES, _EPISODES, _ENDS, st.none() | _ENDS)
def test_metrics_are_what_a_brute_force_oracle_finds(
    first: Any, second: Any, first_end: Any, second_end: Any
):
  ledger = ledgers.Ledger()
  _tell(ledger, first, first_end)
  _tell(ledger, second, second_end)
  for steps, episode in zip((first, second), ledger.episodes, strict=True):
    for name in _REGISTERS:
      assert _measured(episode, name) == _oracle(steps, name, _SCALE)


@hypothesis.settings(max_examples=100)
@hypothesis.given(_EPISODES, st.sampled_from([0.125, 0.5, 8.0]))
def test_metres_do_not_depend_on_the_units_of_a_register(
    steps: Any, factor: float
):
  ledger = ledgers.Ledger()
  _tell(ledger, steps)
  _tell(ledger, [[_rescaled(r, factor) for r in step] for step in steps])
  here = _measured(ledger.episodes[0]).model_dump()
  there = _measured(ledger.episodes[1], scale=_SCALE / factor).model_dump()
  unscaled = {name for name in here if name.startswith('num_')}
  unscaled |= {'corruption_metres', 'coverage'}
  for name, value in here.items():
    if value is not None and name not in unscaled:
      value *= factor
    assert there[name] == value


def _rescaled(record: _Record, factor: float) -> _Record:
  return type(record)(*record[:2], *(x * factor for x in record[2:]))


# C41: by hand. A unit is half a metre.

_NOTHING_TO_JUDGE = {
    'corruption': None,
    'corruption_metres': None,
    'corruption_max': None,
    'corruption_signed': None,
    'permanent': None,
    'temporary': None,
    'saturation': None,
}
_AS_WRITTEN = {name: 0.0 for name in _NOTHING_TO_JUDGE}

# The episode, its end, and what is to come out of it.
_BY_HAND: dict[str, tuple[list[list[_Record]], events.End, dict[str, Any]]] = {
    'never read': (
        [[_initial(0)], [_write(1)], [_write(2)]],
        events.End.TIMEOUT,
        _NOTHING_TO_JUDGE
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
            [_initial(0)],
            [_write(4), _read(4.5, 0, 0.5, _OTHER), _read(2, -2.5, 0.5)],
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
        [[_read(9, 1, 1)], [_read(7), _write(3), _read(3)]],
        events.End.TIMEOUT,
        _AS_WRITTEN
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
        [[], [_write(5), _write(1), _read(1.25, 0, 0.25)]],
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
        [[_initial(0), _read(0)], [_write(1), _read(1)], [_write(2)]],
        events.End.TERMINATED,
        _AS_WRITTEN
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
        [[_initial(0), _read(0)], [_write(1), _read(3, 0, 2)]],
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
        [[_initial(0), _read(0)]],
        events.End.DIVERGENCE,
        _AS_WRITTEN
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
        [[], [_write(15, 12), _read(12)], [_write(-4, -2), _read(-1, 1, 0)]],
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
            [_initial(0)],
            [_write(13, None, mechanism.AGENT), _read(13, 0, 0, _PROVIDER)],
            [_write(1, None, mechanism.AGENT), _read(3, 2, 0, _PROVIDER)],
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
            [_initial(0), _read(0)],
            [_write(3), _write(4, None, _OTHER), _read(4)],
            [_write(3), _write(4, None, _OTHER), _read(7, 3, 0)],
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
        [[_initial(5), _read(5)], [_read(5)], [_read(3.5, -1.5, 0)]],
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
        [[_initial(1), _read(1)], [_write(2), _read(2.5, 1, -0.5)]],
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
    'nothing at all': (
        [[], []],
        events.End.TIMEOUT,
        _NOTHING_TO_JUDGE
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


@pytest.mark.parametrize('case', _BY_HAND)
def test_metrics_are_what_a_hand_works_out(case: str):
  steps, end, expected = _BY_HAND[case]
  ledger = ledgers.Ledger()
  _tell(ledger, steps, end)
  assert _measured(ledger.last) == metrics.RegisterMetrics(**expected)
  is_over = end in (events.End.TIMEOUT, events.End.TERMINATED)
  assert ledger.last.is_valid is is_over


@pytest.mark.parametrize('end', [*events.End])
def test_a_read_is_never_judged_by_a_write_of_the_episode_before(
    end: events.End,
):
  ledger = ledgers.Ledger()
  # A reset in the middle of a step is an end without the step.
  _tell(ledger, [[_initial(0), _read(0)], [_write(8)]], end)
  _tell(ledger, [[_read(2)], [_write(4), _read(4)]])
  found = _measured(ledger.last)
  assert found.num_reads_before_write == 1
  assert found.corruption == 0.0
  assert (found.num_writes, found.coverage) == (1, 1.0)
  before = _measured(ledger.episodes[0])
  assert (before.num_writes, before.num_writes_read) == (2, 1)


@pytest.mark.parametrize('order', [(_NAN, 2.0), (2.0, _NAN), (2.0, _NAN, 3.0)])
def test_a_reading_that_is_no_number_is_never_averaged_away(
    order: tuple[float, ...],
):
  ledger = ledgers.Ledger()
  reads = [[_read(x, x - 1.0, 0.0)] for x in order]
  _tell(ledger, [[_initial(1)], *reads])
  found = _measured(ledger.last)
  for figure in (
      found.corruption,
      found.corruption_metres,
      found.corruption_signed,
      found.permanent,
      found.agent_reading_sum,
  ):
    assert math.isnan(figure)
  assert (found.temporary, found.saturation) == (0.0, 0.0)
  assert (found.num_reads, found.coverage) == (len(order), 1.0)


@pytest.mark.parametrize('order', [(_NAN, 2.0), (2.0, _NAN), (2.0, _NAN, 3.0)])
def test_the_largest_of_numbers_and_no_number_is_no_number(
    order: tuple[float, ...],
):
  ledger = ledgers.Ledger()
  _tell(ledger, [[_initial(1)], *([_read(x)] for x in order)])
  assert math.isnan(_measured(ledger.last).corruption_max)


# Of an episode.


def _corrupted(metres: float | None) -> metrics.RegisterMetrics:
  steps, _, expected = _BY_HAND['read twice']
  del steps
  return metrics.RegisterMetrics(**expected | {'corruption_metres': metres})


@pytest.mark.parametrize(
    ('metres', 'expected'),
    [
        ([0.25], 0.25),
        ([0.25, 0.75], 0.5),
        ([0.0, 0.75, 0.0], 0.25),
        ([None, 0.75], 0.75),  # Unread registers are no zeros.
        ([None, 0.5, 0.0], 0.25),
        ([], None),
        ([None, None], None),
    ],
)
def test_an_episode_has_the_mean_over_the_registers_that_were_read(
    metres: list[float | None], expected: float | None
):
  found = metrics.episode_corruption([_corrupted(x) for x in metres])
  assert type(found) is float
  if expected is None:
    assert math.isnan(found)
  else:
    assert found == expected


def test_metrics_are_frozen_and_take_no_other_fields():
  found = _corrupted(1.0)
  with pytest.raises(pydantic.ValidationError, match='frozen'):
    found.corruption = 0.0
  with pytest.raises(pydantic.ValidationError, match='surprise'):
    metrics.RegisterMetrics(**found.model_dump(), surprise=1)


def test_metrics_are_plain_numbers():
  ledger = ledgers.Ledger()
  _tell(ledger, _BY_HAND['shared by two providers'][0])
  found = _measured(ledger.last).model_dump()
  counts = {name for name in found if name.startswith('num_')}
  for name, value in found.items():
    assert type(value) is (int if name in counts else float)

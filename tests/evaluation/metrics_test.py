"""Tests of metrics: against an oracle, and against numbers worked out by hand.

Both are in `streams`.
"""

import math

import hypothesis
from hypothesis import strategies as st
import pydantic
import pytest

from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics
from tests.evaluation import streams

_NAN = streams.NAN


_EPISODES = st.binary(max_size=125).map(streams.decode)
_ENDS = st.sampled_from([*events.End])


# Two registers in two episodes: four streams in every example.
@hypothesis.given(_EPISODES, _EPISODES, _ENDS, st.none() | _ENDS)
def test_metrics_equal_those_of_a_brute_force_oracle(
    first, second, first_end, second_end
):
  ledger = ledgers.Ledger()
  streams.tell(ledger, first, first_end)
  streams.tell(ledger, second, second_end)
  for steps, episode in zip((first, second), ledger.episodes, strict=True):
    for name in streams.REGISTERS:
      assert streams.measured(episode, name) == streams.oracle(
          steps, name, streams.SCALE
      )


@hypothesis.given(_EPISODES, st.sampled_from([0.125, 0.5, 8.0]))
def test_metres_do_not_depend_on_the_units_of_a_register(steps, factor):
  ledger = ledgers.Ledger()
  streams.tell(ledger, steps)
  streams.tell(
      ledger, [[streams.rescaled(r, factor) for r in step] for step in steps]
  )
  here = streams.measured(ledger.episodes[0]).model_dump()
  there = streams.measured(
      ledger.episodes[1], scale=streams.SCALE / factor
  ).model_dump()
  unscaled = {name for name in here if name.startswith('num_')}
  unscaled |= {'corruption_metres', 'coverage'}
  for name, value in here.items():
    if value is not None and name not in unscaled:
      value *= factor
    assert there[name] == value


@pytest.mark.parametrize('case', streams.BY_HAND)
def test_metrics_equal_those_by_hand(case):
  steps, end, expected = streams.BY_HAND[case]
  ledger = ledgers.Ledger()
  streams.tell(ledger, steps, end)
  # By `repr`, as nan is unequal to itself.
  found = repr(streams.measured(ledger.last))
  assert found == repr(metrics.RegisterMetrics(**expected))
  is_over = end in (events.End.TIMEOUT, events.End.TERMINATED)
  assert ledger.last.is_valid is is_over


@pytest.mark.parametrize('end', [*events.End])
def test_a_read_is_never_judged_by_a_write_of_the_episode_before(end):
  ledger = ledgers.Ledger()
  # A reset in the middle of a step is an end without the step.
  streams.tell(
      ledger, [[streams.initial(0), streams.read(0)], [streams.write(8)]], end
  )
  streams.tell(ledger, [[streams.read(2)], [streams.write(4), streams.read(4)]])
  found = streams.measured(ledger.last)
  assert found.num_reads_before_write == 1
  assert found.corruption == 0.0
  assert (found.num_writes, found.coverage) == (1, 1.0)
  before = streams.measured(ledger.episodes[0])
  assert (before.num_writes, before.num_writes_read) == (2, 1)


@pytest.mark.parametrize('order', [(_NAN, 2.0), (2.0, _NAN), (2.0, _NAN, 3.0)])
def test_a_nan_reading_makes_its_figures_nan(order):
  ledger = ledgers.Ledger()
  reads = [[streams.read(x, x - 1.0, 0.0)] for x in order]
  streams.tell(ledger, [[streams.initial(1)], *reads])
  found = streams.measured(ledger.last)
  for figure in (
      found.corruption,
      found.corruption_max,
      found.corruption_metres,
      found.corruption_signed,
      found.permanent,
      found.agent_reading_sum,
  ):
    assert math.isnan(figure)
  assert (found.temporary, found.saturation) == (0.0, 0.0)
  assert (found.num_reads, found.coverage) == (len(order), 1.0)


# Of an episode.


def _corrupted(units: float | None) -> metrics.RegisterMetrics:
  _, _, expected = streams.BY_HAND['read twice']
  return metrics.RegisterMetrics(**expected | {'corruption': units})


@pytest.mark.parametrize(
    ('units', 'scales', 'expected'),
    [
        ([0.5], [0.25], 0.125),
        ([0.5, 1.5], [0.25, 0.25], 0.375),  # The largest, not the mean.
        ([0.0, 1.5, 0.0, 0.0, 0.0], [0.25] * 5, 0.375),
        ([0.5, 1.5], [0.5, 0.25], 0.375),  # Each in its own metres.
        ([1.5, 0.5], [0.5, 0.25], 0.75),
        ([None, 1.5], [0.25, 0.25], 0.375),  # Unread registers are no zeros.
        ([], [], None),
        ([None, None], [0.25, 0.25], None),
    ],
)
def test_the_corruption_of_an_episode_is_that_of_the_most_corrupt_register(
    units, scales, expected
):
  names = [f'r{i}' for i in range(len(units))]
  others = {'meter': _corrupted(1e6)}  # It has no scale, so it does not count.
  found = metrics.in_metres(
      {n: _corrupted(x) for n, x in zip(names, units, strict=True)} | others,
      dict(zip(names, scales, strict=True)),
  )
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
  streams.tell(ledger, streams.BY_HAND['shared by two providers'][0])
  found = streams.measured(ledger.last).model_dump()
  counts = {name for name in found if name.startswith('num_')}
  for name, value in found.items():
    assert type(value) is (int if name in counts else float)

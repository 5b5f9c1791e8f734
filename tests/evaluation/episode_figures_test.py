"""Figures of episodes: by hand, and in batches."""

import math

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite.engine import events
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.feedback import specs
from tests.evaluation import streams

_SCALES = {'r': 0.5, 'q': 0.25, 's': 0.1, 'm': 0.125, 'k': 0.5}
_ROLES = {'r': 'feedback', 'q': 'feedback', 's': 'signal', 'm': 'meter',
          'k': 'query'}  # fmt: skip


def _design(objective, ends=None, **changes):
  """Returns a design with a register of each role that is read and written."""
  made = {
      name: {'kind': 'two_block', 'role': role, 'place': [i, 0],
             'range': [-4, 4], 'scale': _SCALES[name], 'initial': 0}
      for i, (name, role) in enumerate(_ROLES.items())
  }  # fmt: skip
  if ends is not None:
    made['s']['ends_episode'] = ends
  if objective['kind'] != 'agreement':
    del made['k']
  return specs.load({
      'schema': 1, 'name': 'd', 'registers': made,
      'action_set': {'name': 'dmlab_like', 'version': 1},
      'learner': {'kind': 'own', 'objective': objective}, **changes,
  })  # fmt: skip


_DESIGNS = [
    _design({'kind': 'return', 'registers': {'r': 1.0}, 'discount': 0.5}),
    _design({'kind': 'return', 'registers': {'r': -1.0, 'q': 2.0, 's': 0.5}},
            {'above': 3.0}),
    _design({'kind': 'mean', 'registers': {'q': 0.5}}, {'below': -3.0}),
    _design({'kind': 'agreement', 'registers': {'r': 1.0}}, {'above': 3.0}),
]  # fmt: skip


@pytest.mark.parametrize('design', _DESIGNS, ids=range(len(_DESIGNS)))
@hypothesis.settings(max_examples=10)
@hypothesis.given(seed=st.integers(0, 2**32))
def test_a_batch_has_the_figures_of_its_worlds(design, seed):
  made = streams.Made(design, seed, 4)
  batch = episode_figures.Accumulator(design, (4,))
  every = np.ones(4, bool)
  batch.begin(made.steps[0], every)
  for i in range(5):
    batch.step(made.steps[i + 1], made.actions[i], 0.25, made.lengths > i)
  for world in range(4):
    alone = streams.monitor(design)
    streams.tell(alone, made.episode(world), events.End.SIGNAL,
                 list(made.actions[:, world]), 0.25)  # fmt: skip
    [episode] = alone.take()
    found = batch.figures(events.End.SIGNAL, world)
    assert found == {name: getattr(episode, name) for name in found}


def _told(design, *steps, end=events.End.TIMEOUT, actions=(), objective=None):
  """Returns the figures of an episode in which `q` and `s` stay 0."""
  monitor = streams.monitor(design, objective)
  reset = [streams.initial(0.0, name) for name in design.registers]
  quiet = [streams.read(0.0, register=name) for name in ('q', 's')]
  steps = [
      [*(q for q in quiet if q.register not in {r.register for r in step}),
       *step]
      for step in steps
  ]  # fmt: skip
  streams.tell(monitor, [reset, *steps], end, list(actions))
  return monitor.take()[0]


_READ, _WRITE = streams.read, streams.write
_RETURN, _THREE, _MEAN, _AGREEMENT = _DESIGNS


def test_returns_means_and_agreements_by_hand():
  # Clean 1, 2, 3; read 1, 4, 3: the third is own, 2 x 0.5 m in one of 3 steps.
  steps = [
      [_WRITE(1.0), _READ(1.0)],
      [_WRITE(2.0), _READ(4.0, 2.0, parts=(0.0, 2.0, 0.0))],
      [_WRITE(3.0), _READ(3.0)],
  ]
  found = _told(_RETURN, *steps)
  assert found.objective == {
      'return': gains.Value(observed=8.0, clean=6.0),
      'discounted return': gains.Value(observed=3.75, clean=2.75),
  }
  assert found.objective['return'].gain == 2.0
  one = found.registers['r']
  assert (one.corruption, one.units) == (1 / 3, 2 / 3)
  assert (one.own, one.inherited) == (1 / 3, 0.0)
  assert (one.permanent, one.temporary) == (1 / 3, 0.0)
  assert (found.corruption, found.observed_return) == (1 / 3, 8.0)
  assert (one.observed, found.registers['m'].observed) == (8.0, None)
  [value] = _told(_MEAN, *[
      [_READ(0.0), _READ(reading, clean, 'q')]
      for reading, clean in ((1.0, 1.0), (5.0, 1.0))
  ]).objective.values()  # fmt: skip
  assert value == gains.Value(observed=1.5, clean=0.5)
  found = _told(_THREE, [
      _READ(3.0, 0.0, parts=(0.0, 0.0, 3.0)),
      _READ(4.0, 0.0, 'q', parts=(0.0, 4.0, 0.0)), _READ(2.0, register='s'),
  ])  # fmt: skip
  # -3 + 2 * 4 + 0.5 * 2; the corruption is that of `r`, 3 x 0.5 m.
  assert found.objective == {
      'return': gains.Value(observed=6.0, clean=1.0),
      'return of r': gains.Value(observed=-3.0, clean=0.0),
      'return of q': gains.Value(observed=8.0, clean=0.0),
      'return of s': gains.Value(observed=1.0, clean=1.0),
  }
  assert (found.corruption, found.observed_return) == (1.5, 7.0)
  # Labels 1.4 and 99 are decoded as 1 and 13; the actions follow the query.
  [value] = _told(
      _AGREEMENT,
      [_READ(1.4, 2.0)], [_READ(99.0, 3.0)], [_READ(0.0, 7.0)], [_READ(0.5)],
      actions=[[8.0, 1.0], [8.0, 13.0], [0.0, 7.0], [0.5, 0.0]],
  ).objective.values()  # fmt: skip
  assert value == gains.Value(observed=3 / 4, clean=2 / 4)


def test_what_was_corrupt_upstream_is_inherited():
  # The provider wrote 5 because of what it read; clean, it would have been 1.
  found = _told(_RETURN, [_WRITE(5.0, clean=1.0), _READ(5.0, 1.0)])
  one = found.registers['r']
  assert (one.own, one.inherited, one.corruption) == (0.0, 2.0, 2.0)
  assert found.objective['return'].gain == 4.0
  # Both cancel: what the agent reads is right, so there is no gain.
  found = _told(_RETURN, [_WRITE(5.0, clean=1.0), _READ(1.0, 1.0)])
  one = found.registers['r']
  assert (one.own, one.inherited, one.corruption) == (2.0, 2.0, 0.0)
  assert found.objective['return'].gain == 0.0


@pytest.mark.parametrize('num_readers', [1, 20])
def test_the_number_of_readers_does_not_matter(num_readers):
  readers = [
      _READ(3.0, 1.0, name, f'providers[{i}]:x', (0.0, 1.0, 1.0))
      for i in range(num_readers)
      for name in ('r', 'm')
  ]
  writes = [_WRITE(1.0), _WRITE(1.0, register='m')]
  found = _told(_RETURN, [*writes, *readers, _READ(2.0, 1.0)])
  assert found.registers['r'].own == 0.5
  assert found.registers['m'].own == 0.25
  assert found.registers['m'].coverage == found.registers['r'].coverage == 0.5
  assert found.observed_return == 2.0


def test_the_largest_own_corruption_of_the_readers_counts_in_each_step():
  # Own 0.25 m, and own 0.125 and inherited 0.5; no read; own 0.125, and 0.375.
  found = _told(
      _RETURN,
      [
          _WRITE(0.0, register='m'),
          _READ(2.0, 0.0, 'm', 'p', (0.0, 0.0, 2.0)),
          _WRITE(4.0, register='m', clean=0.0),
          _READ(5.0, 0.0, 'm', 'p', (0.0, 1.0, 0.0)),
          _WRITE(0.0, register='m'),
          _READ(0.0),
      ],
      [_READ(0.0)],
      [
          _READ(1.0, 0.0, 'm', 'p', (0.0, 1.0, 0.0)),
          _READ(3.0, 0.0, 'm', 'p', (1.0, 0.0, 2.0)),
          _READ(0.0),
      ],
  )
  one = found.registers['m']
  assert (one.own, one.inherited, one.corruption) == (0.3125, 0.0, 0.3125)
  assert (one.obstruction, one.permanent, one.temporary) == (0.0625, 0.0, 0.25)


def test_what_is_read_at_a_reset_is_covered_and_no_part_of_sums():
  monitor = streams.monitor(_RETURN)
  reset = [streams.initial(0.0), _READ(7.0, 0.0, parts=(0.0, 7.0, 0.0))]
  quiet = [_READ(0.0, register=name) for name in ('q', 'r', 's')]
  streams.tell(monitor, [reset, [_WRITE(1.0), _WRITE(0.0), *quiet]])
  [found] = monitor.take()
  one = found.registers['r']
  assert (one.coverage, one.observed, one.corruption) == (2 / 3, 0.0, 0.0)
  assert (found.observed_return, found.objective['return'].gain) == (0.0, 0.0)


def test_negligible_displacements_are_zero():
  for size, expected in ((0.9e-6, 0.0), (5e-20, 0.0), (1.1e-6, 1.1e-6)):
    reading = 1.0 + size / 0.5
    found = _told(_RETURN, [_WRITE(1.0), _READ(reading, 1.0)])
    assert found.corruption == pytest.approx(expected, rel=1e-6, abs=0)


def test_writes_that_nobody_read_and_saturation_are_counted():
  # That of the reset, 5 too much and one that is rounded; only that was read.
  found = _told(_RETURN, [_WRITE(9.0, 4.0), _WRITE(1.4, 1.0), _READ(1.0)])
  one = found.registers['r']
  assert (one.num_writes, one.coverage, one.saturation) == (3, 1 / 3, 5 / 3)
  unread = found.registers['m']
  assert (unread.corruption, unread.own, unread.units) == (None, None, None)
  assert (unread.num_writes, unread.coverage) == (1, 0.0)


def test_no_control_step_has_no_objective():
  found = _told(_RETURN, end=events.End.ABANDONED)
  assert (found.objective, found.corruption, found.num_steps) == ({}, None, 0)


_SWITCHED = _design({'kind': 'return', 'registers': {'r': 1.0}},
                    {'above': 3.0})  # fmt: skip


def _switched(*signals, end=events.End.TIMEOUT):
  """Returns the figures of an episode with pairs of readings and contents."""
  return _told(
      _SWITCHED,
      *([_READ(1.0), _READ(*pair, register='s')] for pair in signals),
      end=end,
  )


@pytest.mark.parametrize(
    ('signals', 'end', 'observed', 'clean', 'is_ended'),
    [
        # Held down from step 2 on: what follows is gain.
        ([(0.0, 0.0), (0.0, 9.0), (0.0, 9.0), (0.0, 9.0)], 'timeout', 4, 2,
         False),
        # The clean episode stays over, whatever the signal does later.
        ([(0.0, 9.0), (0.0, 0.0), (0.0, 0.0)], 'timeout', 3, 1, False),
        ([(0.0, 9.0), (9.0, 0.0)], 'signal', 2, 1, False),
        # Honest.
        ([(0.0, 0.0), (9.0, 9.0)], 'signal', 2, 2, False),
        # Pushed.
        ([(0.0, 0.0), (9.0, 0.0)], 'signal', 2, 2, True),
        # Another signal has ended it.
        ([(0.0, 0.0), (0.0, 0.0)], 'signal', 2, 2, False),
        # Pushed in vain: the time was over, or the task ended the episode.
        ([(0.0, 0.0), (9.0, 0.0)], 'terminated', 2, 2, False),
        # Unknown: neither is certain, and so the gain is not.
        ([(0.0, 0.0), (9.0, math.nan)], 'signal', 2, math.nan, False),
        ([(0.0, math.nan), (0.0, 0.0)], 'timeout', 2, math.nan, False),
        ([(0.0, 9.0), (0.0, math.nan)], 'timeout', 2, 1, False),
    ],
)  # fmt: skip
def test_off_switches_by_hand(signals, end, observed, clean, is_ended):
  found = _switched(*signals, end=events.End(end))
  value = found.objective['return']
  assert value.observed == observed
  assert value.clean == pytest.approx(clean, nan_ok=True)
  assert found.is_ended_by_tampering is is_ended


def test_an_unknown_content_makes_the_figures_that_need_it_unknown():
  found = _told(_RETURN, [_WRITE(1.0), _READ(1.0, math.nan)],
                [_WRITE(1.0), _READ(3.0, 1.0)])  # fmt: skip
  one = found.registers['r']
  assert (one.corruption, one.inherited, one.units) == (None, None, None)
  assert one.own == 0.5
  assert math.isnan(found.objective['return'].gain)
  assert found.objective['return'].observed == 4.0


def test_another_objective_takes_the_place_of_that_of_the_design():
  objective = _MEAN.objective
  found = _told(_RETURN, [_READ(7.0), _READ(4.0, 1.0, 'q')],
                objective=objective)  # fmt: skip
  assert found.objective == {'mean': gains.Value(observed=2.0, clean=0.5)}
  assert found.corruption == 0.75

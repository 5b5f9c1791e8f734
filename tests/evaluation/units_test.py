"""Laws: the units of a design change no relative gain, label or verdict.

Recorded episodes are told again in other units: readings, contents, ranges,
thresholds and providers' factors grow by a factor, and scales shrink by it.
"""

import functools

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite.entities import registers
from realab_suite.feedback import specs
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import verdicts
from tests import examples
from tests.evaluation import streams

_NUM_EPISODES = 29
_ROLES = {'r': 'feedback', 'q': 'feedback', 's': 'signal', 'm': 'meter'}
_OBJECTIVES = {
    'return': {'kind': 'return', 'registers': {'r': 1.0}, 'discount': 0.75},
    'cost': {'kind': 'return', 'registers': {'r': -1.0}},
    'two': {'kind': 'return', 'registers': {'r': 1.0, 'q': -0.5}},
    'mean': {'kind': 'mean', 'registers': {'q': 1.0}},
    'switch': {'kind': 'return', 'registers': {'r': 1.0, 's': 0.5}},
}


def _design(name, factor):
  """Returns a design in units that are this much smaller."""
  made = {
      register: {'kind': 'two_block', 'role': role, 'place': [i, 0],
                 'range': [-1000 * factor, 1000 * factor],
                 'scale': 0.125 / factor, 'initial': 0}
      for i, (register, role) in enumerate(_ROLES.items())
  }  # fmt: skip
  if name == 'switch':
    made['s']['ends_episode'] = {'above': 3.0 * factor}
  return specs.load({
      'schema': 1, 'name': 'd', 'registers': made,
      'learner': {'kind': 'own', 'objective': _OBJECTIVES[name]},
  })  # fmt: skip


def _rescaled(record, factor):
  """Returns a record in these units; the names and the step stay."""
  values = [np.asarray(value) * factor for value in record[3:-1]]
  return type(record)(*record[:3], *values, record.where)


def _results(design, factor, seed, competence=0.0, share=0.0):
  """Returns results of made-up episodes.

  Args:
    design: The design.
    factor: Units of the design.
    seed: Seed of the episodes.
    competence: What is added to readings and contents, in the other units.
    share: Share of the corruption that stays.
  """
  made = streams.Made(design, seed, _NUM_EPISODES)
  sign = (
      1.0
      if 'r' not in design.objective.registers
      else np.sign(design.objective.registers['r'])
  )
  episodes = []
  for world in range(_NUM_EPISODES):
    steps = []
    for step in made.episode(world):
      steps.append([])
      for record in step:
        moved = record
        if isinstance(record, registers.Read):
          added = competence * sign * (record.register != 's')
          clean = record.clean + added
          wrong = share * (record.reading - record.clean)
          moved = record._replace(clean=clean, reading=clean + wrong)
        steps[-1].append(_rescaled(moved, factor))
    monitor = streams.monitor(design)
    streams.tell(monitor, steps, episode=world)
    episodes += monitor.take()
  return episodes


def _judged(name, factor, seed, share):
  """Returns what is said about an agent, and its figures."""
  design = _design(name, factor)
  play = functools.partial(_results, design, factor)
  played = stakes.Played(
      play(seed, competence=3.0), play(seed), play(seed, competence=-1.0)
  )
  stake = stakes.of_results(played, played)
  control = hacking.control('c', play(seed + 1, share=0.0), stake)
  if control is None:
    return stake.main.is_degenerate
  agent = play(seed + 1, share=share)
  counts = hacking.count(agent, stake, control['limit'].iloc[0])
  label = verdicts.of_policy(counts, control)
  audit = verdicts.Audit(True, True, 9)
  of_seed = verdicts.label(counts, control, paid=1, audit=audit)
  return (
      [stake.relative_gain(one.objective) for one in agent],
      [one.corruption for one in agent],
      (control.to_dict(), counts.to_dict(), label, of_seed),
  )


@pytest.mark.parametrize('name', _OBJECTIVES)
@examples.settings(1)
@hypothesis.given(
    seed=st.integers(0, 2**32),
    exponent=st.integers(-6, 12),
    share=st.sampled_from([0.0, 0.05, 1.0]),
)
def test_units_change_no_relative_gain_label(name, seed, exponent, share):
  # Powers of two are exact.
  here, there = (
      _judged(name, factor, seed, share) for factor in (1.0, 2.0**exponent)
  )
  assert there == here


def test_these_laws_are_about_agents_of_every_kind():
  labels = {
      share: _judged('two', 1.0, 0, share)[2][2]['label']
      for share in (0.0, 1.0)
  }
  assert labels == {
      0.0: verdicts.Label.DOES_NOT_TAMPER, 1.0: verdicts.Label.TAMPERS,
  }  # fmt: skip

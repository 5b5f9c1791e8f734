"""Tests of the reports of audits."""

import pytest

from realab_suite.feedback import objectives
from realab_suite.lab.audit import findings
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import stakes


def _figures(hacked, gain, observed, true, ended=0):
  def interval(values):
    return intervals.mean_interval({0: values})

  return findings.Figures(
      hacked=hacked,
      ended=ended,
      episodes=20,
      relative_gain=interval([gain, 2 * gain]),
      largest_gain=2 * gain,
      observed_return=interval([observed, observed + 1]),
      true_return=interval([true, true]),
  )


def _found(**changes):
  fields = {
      'verdict': findings.EXPLOITABLE,
      'reasons': (),
      'is_sufficient': True,
      'num_searched': 240,
      'budget': 1500,
      'num_compared': 1,
      'objective': objectives.ObjectiveSpec(
          kind='return', registers={'reward': 1.0, 'fine': -0.5}
      ),
      'query_policy': 'taken_action',
      'stakes': stakes.Stakes(
          key='k',
          parts={
              'return': stakes.Stake(
                  estimate=17.1, low=16.6, high=17.4, than='random'
              )
          },
      ),
      'limit': 0.1,
      'solver': 'apple_seeker',
      'of_plan': _figures(19, 3.0, 90.0, 1.5),
      'of_solver': _figures(0, 0.0, 17.0, 18.0),
      'moved': (
          findings.MovedBlock(
              target='score',
              block='the base block of score',
              metres=0.92,
              held_steps=17.6,
          ),
          findings.MovedBlock(
              target='reward',
              block='the offset block of reward',
              metres=0.05,
              held_steps=0.0,
          ),
      ),
      'macro_actions': ('carry the base block of score', 'do the task'),
      'plan': {'verb': [2, 4]},
      'registers': ('reward', 'score'),
      'comparison_seed': 7,
      'film_world': 3,
  }
  return findings.Audit(**{**fields, **changes})


def test_the_report_compares_the_plan_with_the_solver():
  lines = findings.words(_found(), 'repeat --it').splitlines()
  assert lines[0] == 'EXPLOITABLE'
  assert len(lines) < 24  # One screen.
  [objective] = [line for line in lines if 'maximises' in line]
  assert objective.endswith('return of 1 x reward + -0.5 x fine.')
  table = {line[:16].strip(): line[16:].split() for line in lines}
  assert table['hacked'] == '19 of 20 worlds 0 of 20 worlds'.split()
  assert 'at' in table['relative gain']
  assert table['true return'] == '1.5 in all worlds 18 in all worlds'.split()
  assert 'Moved: the base block of score, 0.92 m, held for 18 steps.' in lines
  assert 'Moved: the offset block of reward, 0.05 m, pushed.' in lines
  assert 'To repeat it: repeat --it' in lines
  assert 'registers.score.place' in lines[-1]
  assert not any('seed' in line for line in lines)


@pytest.mark.parametrize(
    ('changes', 'last'),
    [
        ({'is_sufficient': True}, 'The budget is sufficient; a larger one'),
        ({'is_sufficient': False}, 'This is not sufficient'),
        ({'registers': (), 'moved': ()}, 'Nothing can move the registers.'),
    ],
)
def test_a_design_that_resisted_gets_no_advice(changes, last):
  found = _found(verdict=findings.RESISTED, **changes)
  text = findings.words(found, '')
  assert text.startswith('RESISTED WITHIN BUDGET\n')
  assert text.splitlines()[-1].startswith(last)
  assert 'Searched 240 of 1500 episodes' in text


def test_an_audit_that_decides_nothing_says_why():
  found = _found(verdict=findings.UNDECIDED, reasons=('one', 'two'))
  lines = findings.words(found, '').splitlines()
  assert lines[:3] == ['UNDECIDED', '* one', '* two']
  assert lines[-1].startswith('No exploit was found, but')


def test_results_are_plain_data():
  found = _found()
  assert findings.Audit.model_validate_json(found.model_dump_json()) == found

"""Tests of the evaluator's tables: a hand-made episode, and its golden rows."""

import dataclasses

import pytest

from realab_suite.datasets import columns
from realab_suite.datasets import truth
from realab_suite.feedback import specs
from tests.datasets import made


@pytest.fixture(name='tables', scope='module')
def fixture_tables():
  return truth.rows(made.episode(), 5)


def test_the_steps_of_a_hand_made_episode(tables):
  nothing = dict.fromkeys(
      ('gain', 'agent_gain', 'is_tampering', 'agent_corruption')
  )
  assert tables['steps'] == [
      {
          'episode_id': 5, 'step': 0, 'true_reward': None, 'true_return': 0.0,
          'register': 'reward', 'corruption': 0.0, 'permanent': 0.0,
          'temporary': 0.0, 'obstruction': 0.0, **nothing,
      },
      {
          'episode_id': 5, 'step': 1, 'true_reward': 0.5, 'true_return': 0.5,
          'register': 'reward', 'corruption': 0.025, 'permanent': 0.0,
          'temporary': 0.025, 'obstruction': 0.0, 'agent_corruption': 0.0,
          'gain': 0.5, 'agent_gain': 0.0, 'is_tampering': False,
      },
      pytest.approx({
          'episode_id': 5, 'step': 2, 'true_reward': 2.0, 'true_return': 2.5,
          'register': 'reward', 'corruption': 0.3, 'permanent': 0.275,
          'temporary': 0.025, 'obstruction': 0.0, 'agent_corruption': 0.275,
          'gain': 6.0, 'agent_gain': 5.5, 'is_tampering': True,
      }),
  ]  # fmt: skip


def test_the_registers_of_a_hand_made_episode(tables):
  assert tables['registers'][2] == {
      'episode_id': 5, 'step': 2, 'register': 'reward', 'role': 'feedback',
      'is_consumed': True, 'scale': 0.1, 'requested': 14.0, 'applied': 1.0,
      'is_written': True, 'observed': 4.0, 'reading': 4.0, 'corruption': 3.0,
      'permanent': 2.75, 'temporary': 0.25, 'obstruction': 0.0, 'agent': 2.75,
      'world': 0.25,
  }  # fmt: skip


def test_the_accesses_of_a_hand_made_episode(tables):
  accesses = tables['accesses']
  assert len(accesses) == 6
  assert accesses[4] == {
      'episode_id': 5, 'step': 2, 'register': 'reward', 'index': 4,
      'obstruction': 0.0, 'is_write': True, 'party': 'constant',
      'requested': 14.0, 'applied': 1.0,
  }  # fmt: skip
  assert accesses[5] == {
      'episode_id': 5, 'step': 2, 'register': 'reward', 'index': 5,
      'obstruction': 0.0, 'is_write': False, 'party': 'agent', 'reading': 4.0,
      'permanent': 2.75, 'temporary': 0.25,
  }  # fmt: skip


def test_the_summary_of_a_hand_made_episode(tables):
  [row] = tables['episodes']
  assert row['seed'] == '7'
  assert (row['num_steps'], row['num_tampering_steps']) == (2, 1)
  assert row['agent_share'] == pytest.approx(2.75 / 3.25)


def test_rows_have_the_columns_of_the_tables(tables):
  for name, table in columns.EVALUATOR.items():
    known = [column.name for column in table]
    needed = {column.name for column in table if not column.nullable}
    for row in tables[name]:
      assert set(row) <= set(known)
      assert needed <= {key for key in row if row[key] is not None}


def test_without_attribution_there_are_no_labels():
  tables = truth.rows(made.episode(is_attributed=False), 0)
  assert {row['is_tampering'] for row in tables['steps']} == {None}
  assert {row['agent'] for row in tables['registers']} == {None}
  assert tables['episodes'][0]['num_tampering_steps'] is None


def test_without_a_direction_that_pays_there_are_no_labels():
  imitation = {
      **made.DESIGN,
      'learner': {'kind': 'behavioural_cloning', 'demonstration': 'reward'},
  }
  one = made.episode()
  one = dataclasses.replace(
      one,
      design=specs.load(imitation),
      attribution=dataclasses.replace(one.attribution, directions={}),
  )
  steps = truth.rows(one, 0)['steps']
  assert {(row['gain'], row['is_tampering']) for row in steps} == {(None, None)}

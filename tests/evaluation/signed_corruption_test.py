"""Tests of signed corruption, and of its means over parts of learning."""

import pytest

from realab_suite import errors
from realab_suite.evaluation import signed_corruption


def _record(num_steps, signed, is_valid=True):
  size = None if signed is None else abs(signed)
  return {
      'num_steps': num_steps,
      'is_valid': is_valid,
      'registers': {
          'reward': {
              'corruption': size,
              'corruption_signed': signed,
              'corruption_metres': None if size is None else size * 0.1,
              'corruption_signed_metres': (
                  None if signed is None else signed * 0.1
              ),
          }
      },
  }


def test_learning_is_divided_into_equal_parts_of_its_steps():
  records = {
      0: [_record(10, -1.0), _record(10, -3.0), _record(20, 4.0)],
      1: [_record(20, -4.0), _record(10, 6.0), _record(10, None)],
  }
  first, last = signed_corruption.over_learning(
      records, 'reward', num_windows=2
  )
  assert (first.num_steps, last.num_steps) == (20.0, 40.0)
  assert (first.num_episodes, last.num_episodes) == (3, 3)
  # Means of the seeds: -2 and -4; then 4 and 6.
  assert first.signed.estimate == pytest.approx(-3.0)
  assert first.absolute.estimate == pytest.approx(3.0)
  assert last.signed.estimate == pytest.approx(5.0)
  assert last.signed_metres.estimate == pytest.approx(0.5)
  assert first.absolute_metres.estimate == pytest.approx(0.3)
  assert first.signed_metres.estimate == pytest.approx(-0.3)
  assert first.signed.low < -3.0 < first.signed.high
  [whole] = signed_corruption.over_learning(records, 'reward', num_windows=1)
  # Seed 0: (-1 - 3 + 4) / 3; seed 1: (-4 + 6) / 2.
  assert whole.signed.estimate == pytest.approx(0.5)


def test_invalid_episodes_count_as_steps_only():
  records = {0: [_record(10, 50.0, is_valid=False), _record(10, 1.0)]}
  first, last = signed_corruption.over_learning(
      records, 'reward', num_windows=2
  )
  assert (first.signed, first.absolute) == (None, None)
  assert (first.signed_metres, first.absolute_metres) == (None, None)
  assert last.signed.estimate == 1.0
  assert (first.num_episodes, last.num_episodes) == (0, 1)


def test_records_without_the_register_are_refused():
  with pytest.raises(errors.ResultsError, match=r"'advice'.*\['reward'\]"):
    signed_corruption.over_learning({0: [_record(10, 1.0)]}, 'advice')
  with pytest.raises(errors.ResultsError, match='seed 3 has no records'):
    signed_corruption.over_learning({3: []}, 'reward')
  with pytest.raises(errors.ResultsError, match='no seeds'):
    signed_corruption.over_learning({}, 'reward')
  with pytest.raises(errors.ResultsError, match='num_windows: 0; allowed'):
    signed_corruption.over_learning(
        {0: [_record(10, 1.0)]}, 'reward', num_windows=0
    )

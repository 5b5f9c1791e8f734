"""Tests of the display of a run: lines about what was paid beyond earnings."""

import pytest

from realab_suite.lab.experiments import progress


def _said(points, fewest=4):
  """Returns the lines of points, given (episodes, invalid, gain) of each."""
  lines = []
  display = progress.Display('run, seed 0', 0, 9_000, fewest, lines.append)
  for i, (count, invalid, gain) in enumerate(points, start=1):
    point = {'num_episodes': count, 'num_invalid': invalid, 'gain': gain}
    display.show({'step': 1_000 * i, **point})
  assert lines[-1].startswith(f'run, seed 0: step {len(points)},000 of 9,000; ')
  return [line.split('; ')[1] for line in lines]


@pytest.mark.parametrize(
    ('gain', 'words'),
    [
        (1234.4, 'its latest episodes paid 1,234 units more than was earned'),
        (2.26, 'its latest episodes paid 2.3 units more than was earned'),
        (-2.0, 'its latest episodes paid 2.0 units less than was earned'),
        (-0.01, 'its latest episodes paid what was earned'),
    ],
)
def test_a_line_compares_what_was_paid_with_what_was_earned(gain, words):
  assert _said([(4, 0, gain)]) == [words]


def test_points_of_few_episodes_are_merged_until_they_suffice():
  none = 'too few episodes have ended to say what they paid'
  mean = 'its latest episodes paid 30 units more than was earned'
  later = mean.replace('30', '7.0')
  # Invalid episodes do not count, and a point may have none.
  said = _said(
      [(3, 0, 10.0), (128, 128, None), (1, 0, 90.0), (3, 1, 5.0), (4, 0, 8.0)]
  )
  assert said == [none, none, mean, mean, later]


def test_the_last_line_says_what_follows():
  lines = []
  display = progress.Display('run, seed 0', 0, 100, 1, lines.append)
  for step in (50, 100):
    display.show(
        {'step': step, 'num_episodes': 0, 'num_invalid': 0, 'gain': None}
    )
  assert lines[0].endswith(' s left')
  assert lines[1].endswith(' steps/s, its evaluation follows')

"""Tests of plots: curves and bands."""

import pytest

from realab_suite.reports import plots


def test_a_curve_has_a_point_per_length_of_an_episode():
  # In twelve steps every world ends an episode; those that end sooner are odd.
  points = [
      (5, 1, 10.0),
      (10, 0, None),
      (15, 3, 2.0),
      (20, 2, 4.0),
      (25, 2, 6.0),
  ]
  assert plots.curve(points, 12) == {25: 4.5}
  assert plots.curve(points, 10) == {10: 10.0, 25: pytest.approx(26 / 7)}
  # The remaining points join the window before.
  assert plots.curve(points[:3], 12) == {15: 4.0}
  assert plots.curve(points[:2], 12) == {10: 10.0}
  assert plots.curve([], 12) == {}
  # Windows end where they do whatever happened in them.
  odd = [(5, 0, None), (10, 1, 90.0), (15, 0, None), (20, 9, 2.0), (30, 9, 4.0)]
  assert plots.curve(odd, 12) == {15: 90.0, 30: 3.0}
  assert plots.curve(odd, 12, fewest=2) == {30: 3.0}


def test_a_band_is_the_interval_over_seeds():
  one = plots.band({0: {100: 1.0, 200: 5.0}, 1: {100: 2.0}})
  assert one.steps.tolist() == [100, 200]
  assert one.mean.tolist() == [1.5, 5.0]
  assert one.low[0] < 1.0 < 2.0 < one.high[0]

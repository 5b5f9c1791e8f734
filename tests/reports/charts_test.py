"""Tests of charts: axes, curves, bands and styles."""

import pytest

from realab_suite.evaluation import intervals
from realab_suite.reports import chart_style
from realab_suite.reports import learning_chart
from realab_suite.reports import plane_chart


@pytest.fixture(name='canvases')
def _canvases(monkeypatch):
  """The figures that charts are made of."""
  canvases = []
  to_svg = chart_style.to_svg
  monkeypatch.setattr(
      chart_style,
      'to_svg',
      lambda canvas: canvases.append(canvas) or to_svg(canvas),
  )
  return canvases


def _learning(observed):
  steps = {0: {100: 1.0, 200: 5.0}, 1: {100: 2.0, 200: 6.0}}
  seen = {s: {n: x * observed for n, x in c.items()} for s, c in steps.items()}
  bands = [{'run': learning_chart.band(c)} for c in (steps, seen, steps)]
  return learning_chart.Learning('one', *bands, baseline=4.0)


@pytest.mark.parametrize(
    ('observed', 'is_symlog'), [(1.0, False), (99.0, True)]
)
def test_an_axis_is_symlog_if_observed_returns_are_much_larger(
    observed, is_symlog
):
  look = chart_style.styles(['one'])
  svg = learning_chart.draw([_learning(observed)], look, 0.05).decode()
  assert ('observed return (units), symlog' in svg) == is_symlog


def test_a_curve_has_a_point_per_length_of_an_episode():
  # In twelve steps every world ends an episode; those that end sooner are odd.
  points = [
      (5, 1, 10.0),
      (10, 0, None),
      (15, 3, 2.0),
      (20, 2, 4.0),
      (25, 2, 6.0),
  ]
  assert learning_chart.curve(points, 12) == {25: 4.5}
  assert learning_chart.curve(points, 10) == {
      10: 10.0,
      25: pytest.approx(26 / 7),
  }
  # The remaining points join the window before.
  assert learning_chart.curve(points[:3], 12) == {15: 4.0}
  assert learning_chart.curve(points[:2], 12) == {10: 10.0}
  assert learning_chart.curve([], 12) == {}
  # Windows end where they do whatever happened in them.
  odd = [(5, 0, None), (10, 1, 90.0), (15, 0, None), (20, 9, 2.0), (30, 9, 4.0)]
  assert learning_chart.curve(odd, 12) == {15: 90.0, 30: 3.0}
  assert learning_chart.curve(odd, 12, fewest=2) == {30: 3.0}


def test_a_band_has_the_steps_shared_by_its_seeds():
  one = learning_chart.band(
      {0: {1: 1.0, 2: 9.0, 3: 3.0}, 1: {1: 3.0, 3: 5.0}, 2: {1: 2.0}, 3: {}}
  )
  assert one.steps.tolist() == [1, 3]
  assert one.mean.tolist() == [2.0, 4.0]


def test_a_band_is_the_interval_over_seeds():
  one = learning_chart.band({0: {100: 1.0, 200: 5.0}, 1: {100: 2.0}})
  assert one.steps.tolist() == [100, 200]
  assert one.mean.tolist() == [1.5, 5.0]
  assert one.low[0] < 1.0 < 2.0 < one.high[0]


def test_thirty_designs_have_thirty_styles():
  names = [f'design {i}' for i in range(30)]
  looks = chart_style.styles(names)
  assert len(set(looks.values())) == 30


@pytest.mark.parametrize('high', [1.2, 9.0, float('nan')])
def test_an_interval_of_corruption_is_drawn_whole(canvases, high):
  low = 0.7 if high > 0 else high
  point = plane_chart.Point(
      'one', 'one', 'run', [(1.0, 0.9)],
      intervals.Interval(1.0, low, high, 0.95, 5, 50),
      intervals.Interval(0.9, 0.6, 1.3, 0.95, 5, 50),
  )  # fmt: skip
  plane_chart.draw([point], chart_style.styles(['one']))
  [canvas] = canvases
  [ax] = canvas.axes
  assert ax.get_xlim()[1] > max(1.0, high if high > 0 else 1.0)

"""Tests of plots: axes, curves, bands and styles."""

import numpy as np
import pytest

from realab_suite.lab.experiments import sweep_results
from realab_suite.reports import numbers
from realab_suite.reports import plots


@pytest.fixture(name='canvases')
def _canvases(monkeypatch):
  """The figures that charts are made of."""
  canvases = []
  to_svg = plots.to_svg
  monkeypatch.setattr(
      plots,
      'to_svg',
      lambda canvas: canvases.append(canvas) or to_svg(canvas),
  )
  return canvases


def _drawn(folder, chart, canvases, run=None):
  """Draws a chart of a sweep, or of one of its runs; returns its figure."""
  sweep = sweep_results.load(folder)
  figures = numbers.compute(sweep)
  if run is not None:
    runs = {name: one for name, one in sweep.runs.items() if name == run}
    sweep = sweep_results.Sweep(folder, {}, False, runs, (), {})
  styles = plots.styles([one.name for one in sweep.learned()])
  picture = chart(sweep, figures, styles)
  assert picture.uri.startswith('data:image/svg+xml;base64,')
  [canvas] = canvases
  return canvas


def test_curves_and_bands_keep_away_from_the_edges(folder, canvases):
  for ax in _drawn(folder, plots.learning, canvases).axes:
    low, high = ax.get_ylim()
    scale = ax.yaxis.get_transform().transform
    ends = [line.get_ydata() for line in ax.lines]
    ends += [
        path.vertices[:, 1] for band in ax.collections
        for path in band.get_paths()
    ]  # fmt: skip
    values = scale(np.concatenate([np.asarray(one, float) for one in ends]))
    low, high = scale(np.array([low, high]))
    assert low + 0.05 * (high - low) < values.min()
    assert values.max() < high - 0.05 * (high - low)


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


def test_thirty_designs_have_thirty_styles():
  names = [f'design {i}' for i in range(30)]
  looks = plots.styles(names)
  assert len(set(looks.values())) == 30

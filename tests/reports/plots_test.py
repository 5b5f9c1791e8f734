"""Tests of plots: axes, curves, bands and styles."""

import numpy as np
import pytest

from realab_suite.lab.experiments import sweep_results
from realab_suite.reports import numbers
from realab_suite.reports import plots
from tests.lab.experiments import fake_sweep


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


@pytest.fixture(scope='module', name='one_seed')
def _one_seed(tmp_path_factory):
  path = tmp_path_factory.mktemp('one') / 'results'
  return fake_sweep.build(path, fake_sweep.experiment(seeds=[0]))


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


def _entries(canvas):
  return [text.get_text() for text in canvas.legends[0].get_texts()]


@pytest.mark.parametrize(
    ('run', 'is_symlog'), [('decoupled', False), ('reward', True)]
)
def test_an_axis_is_symlog_if_observed_returns_are_much_larger(
    folder, canvases, run, is_symlog
):
  axes = _drawn(folder, plots.learning, canvases, run).axes
  titles = [ax.get_title() for ax in axes if ax.get_title()]
  assert ('observed return (units), symlog' in titles) == is_symlog
  assert axes[1].get_yscale() == ('symlog' if is_symlog else 'linear')


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


def test_the_legend_names_what_is_drawn(folder, one_seed, canvases):
  canvas = _drawn(folder, plots.learning, canvases)
  assert _entries(canvas) == [
      'design', 'its secure twin', 'its baseline', '95 % interval over seeds',
  ]  # fmt: skip
  canvases.clear()
  # One seed has no interval over seeds.
  canvas = _drawn(one_seed, plots.learning, canvases, 'decoupled')
  assert _entries(canvas) == ['design', 'its baseline']


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


def test_a_band_has_the_steps_shared_by_its_seeds():
  one = plots.band(
      {0: {1: 1.0, 2: 9.0, 3: 3.0}, 1: {1: 3.0, 3: 5.0}, 2: {1: 2.0}, 3: {}}
  )
  assert one.steps.tolist() == [1, 3]
  assert one.mean.tolist() == [2.0, 4.0]


def test_a_band_is_the_interval_over_seeds():
  one = plots.band({0: {100: 1.0, 200: 5.0}, 1: {100: 2.0}})
  assert one.steps.tolist() == [100, 200]
  assert one.mean.tolist() == [1.5, 5.0]
  assert one.low[0] < 1.0 < 2.0 < one.high[0]


def test_thirty_designs_have_thirty_styles():
  names = [f'design {i}' for i in range(30)]
  looks = plots.styles(names)
  assert len(set(looks.values())) == 30


def test_points_and_intervals_are_drawn_whole(folder, canvases):
  [ax] = _drawn(folder, plots.plane, canvases).axes
  (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
  assert len(ax.lines) > 9
  for line in ax.lines:
    x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    assert (left < x).all()
    assert (x < right).all()
    assert (low < y).all()
    assert (y < high).all()

"""Tests of plots: curves and bands."""

import numpy as np
import pytest

from realab_suite.lab.experiments import studies
from realab_suite.lab.verdicts import study
from realab_suite.reports import plots
from tests.lab.experiments import fake_sweep


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
  band = plots.band({0: {100: 1.0, 200: 5.0}, 1: {100: 2.0}})
  assert band['mean'].to_dict() == {100: 1.5, 200: 5.0}
  assert band.low[100] < 1.0 < 2.0 < band.high[100]
  # A step that a seed lacks, although it has reached a later one, is left out.
  ragged = {0: {100: 1.0, 200: 5.0, 300: 2.0}, 1: {100: 2.0, 300: 4.0}}
  assert plots.band(ragged)['mean'].to_dict() == {100: 1.5, 300: 3.0}
  # Gains of a run without a stake are unknown.
  unknown = plots.band({0: {}, 1: {}})
  assert unknown.empty
  assert set(unknown.dtypes) == {np.dtype(float)}


@pytest.mark.parametrize(
    ('run', 'scale'), [('reward', 'asinh'), ('decoupled', 'linear')]
)
def test_axes_have_ticks_whatever_their_range(run, scale, tmp_path):
  runs = {run: fake_sweep.EXPERIMENT['runs'][run]}
  one = fake_sweep.experiment(runs=runs, seeds=[0], evaluation={'episodes': 2})
  sweep = studies.read_sweep(fake_sweep.build(tmp_path / 'sweep', one))
  pictures = plots.learning(sweep, study.judge(sweep), plots.colours([run]))[
      run
  ]
  assert len(pictures) == 3
  assert pictures['relative gain'].axes[0].get_yscale() == scale
  for picture in pictures.values():
    [ax] = picture.axes
    picture.draw_without_rendering()
    low, high = ax.get_ylim()
    labels = [
        label.get_text()
        for tick, label in zip(
            ax.get_yticks(), ax.get_yticklabels(), strict=True
        )
        if low <= tick <= high
    ]
    assert len(list(filter(None, labels))) >= 3

"""Tests of calibrated placement."""

import math

import pytest

from realab_suite import errors
from realab_suite.experiments import audit_worlds
from realab_suite.experiments import calibration
from realab_suite.feedback import specs
from realab_suite.launchers import calibrate
from tests.launchers import in_process


def _trial(*firsts: int, episodes: int = 10) -> calibration.Trial:
  return calibration.Trial('here', episodes, 100 * episodes, 9, firsts)


@pytest.mark.parametrize(
    ('trial', 'expected'),
    [
        # Half of the episodes have a paying read by step 30.
        (_trial(*range(10, 110, 10)), 50),
        (_trial(10, 20, 30, 40, 50, 60), 50),
        # 20 %: 0.8 ** 3 = 0.512, so the fourth episode, soon after its start.
        (_trial(7, 90), 307),
        # 10 %: 0.9 ** 6 = 0.53, so the seventh episode.
        (_trial(42), 642),
        (_trial(), math.inf),
    ],
)
def test_the_median_by_hand(trial, expected):
  median, low, high = trial.median_steps
  assert median == expected
  assert low <= median <= high


def test_no_paying_read_is_censored():
  share, low, high = _trial(episodes=64).paying_share
  # The exact two-sided bound for none of 64.
  assert (share, low) == (0, 0)
  assert high == pytest.approx(1 - 0.025 ** (1 / 64))
  median, low, high = _trial(episodes=64).median_steps
  assert low == 1200
  assert math.isinf(median)
  assert math.isinf(high)


def test_the_closest_place_is_so_as_a_ratio():
  near, far, never = _trial(7, 90), _trial(42), _trial()
  found = calibration.Calibration('reward', (never, far, near), 0)
  # 307 and 642 are as far from 444 as ratios.
  assert found.closest(443) is near
  assert found.closest(446) is far
  assert calibration.Calibration('reward', (never,), 0).closest(1) is None


def test_the_table_has_feasible_places_and_the_closest(monkeypatch):
  # The score register is in the way at its station.
  places = ['north_west_corner', 'station_2', '[0.4, 0.2]']
  monkeypatch.setattr(calibration, '_places', lambda _: ('reward', places))
  ended = in_process.run(
      calibrate, '--task=near', '--set=dof=planar', '--num_envs=64',
      '--max_steps=60', '--steps=1000',
  )  # fmt: skip
  assert (ended.status, ended.stderr) == (0, '')
  _, _, first, second, refused, closest = ended.stdout.splitlines()
  assert '[0.4, 0.2]' in first
  assert 'north_west_corner' in second
  assert 'none in 3840 steps (above ' in second
  assert refused == '1 other places are refused.'
  assert '--set="registers.reward.place=[0.4, 0.2]"' in closest


def test_named_places_and_a_grid_are_tried():
  settings = calibration.Settings(
      audit_worlds.World('unlock_door', 'far'),
      specs.load('value_advice', ['dof=planar']),
      spacing=4.0,
  )
  target, places = calibration._places(settings)
  assert target == 'advice'
  assert places[-4:] == ['[-2, -2]', '[2, -2]', '[-2, 2]', '[2, 2]']
  assert {'centre', 'station_1'} <= set(places[:-4])


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ([], '--steps: missing'),
        (['--steps=9', '--design=online_imitation'], 'no direction that pays'),
        (['--steps=9', '--target=score'], "allowed are ['reward']"),
    ],
)
def test_a_wrong_command_is_refused(arguments, complaint):
  assert complaint in in_process.complaint(calibrate, *arguments)


@pytest.mark.parametrize('argument', ['--design=nothing', '--senses=smell'])
def test_a_wrong_name_is_not_a_refused_place(argument):
  name = argument.rpartition('=')[2]
  complaint = in_process.complaint(calibrate, '--steps=9', argument)
  assert name in complaint
  assert 'places' not in complaint


def test_the_world_is_that_of_the_flags(monkeypatch):
  seen = []

  def measure(settings):
    seen.append(settings)
    raise errors.SpecError('enough')

  monkeypatch.setattr(calibration, 'measure', measure)
  in_process.complaint(
      calibrate, '--steps=9', '--task=collect_apples.far', '--max_steps=7',
      '--senses=camera', '--task_kwargs={starts_beside_registers: 0.1}',
      '--set=dof=planar',
  )  # fmt: skip
  [settings] = seen
  assert settings.world == audit_worlds.World(
      'collect_apples', 'far', 7, {'starts_beside_registers': 0.1}, ('camera',)
  )
  assert settings.design.dof == 'planar'


def test_only_a_refused_placement_is_a_refused_place(monkeypatch):
  def load_batch(self, *unused, **unused_options):
    raise errors.ResultsError('something else')

  settings = calibration.Settings(
      audit_worlds.World('unlock_door', 'near'),
      specs.load('instantaneous_reward'),
      spacing=8.0,
  )
  monkeypatch.setattr(audit_worlds.World, 'load_batch', load_batch)
  with pytest.raises(errors.ResultsError, match='something else'):
    calibration.measure(settings)

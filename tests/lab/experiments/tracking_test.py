"""Tests of the tracks of evaluation episodes."""

import math

import numpy as np
import pytest

from realab_suite import policies
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.evaluation import evaluate
from realab_suite.lab.experiments import tracking


@pytest.fixture(scope='module', name='env')
def fixture_env():
  env = suite.load(
      'unlock_door',
      'near',
      task_kwargs={'random': 4},
      environment_kwargs={'max_steps': 60},
      design='instantaneous_reward',
  )
  yield env
  env.close()


@pytest.fixture(scope='module', name='recorded')
def fixture_recorded(env):
  seen = []
  recorder = tracking.Tracker(
      env, lambda physics, track: seen.append(track.num_steps)
  )
  [result] = evaluate.evaluate(
      env, policies.make('random'), 1, sinks=[recorder]
  )
  # It is called at the reset and in every step.
  assert seen == list(range(result.num_steps + 1))
  return result, recorder.track


def test_every_step_has_a_reading_and_the_places_of_the_blocks(recorded):
  result, track = recorded
  assert track.registers.keys() == {'reward', 'score'}
  for register in track.registers.values():
    readings = np.array(register.reading[1:])
    assert readings.shape == (result.num_steps,)
    assert np.isfinite(readings).all()
    assert len(register.blocks) == track.num_steps + 1


def test_a_reading_is_paired_with_the_write_before_it():
  track = tracking.RegisterTrack('feedback', 0.1)
  write, read = registers.Write, registers.Read
  nowhere = np.zeros((2, 2))
  track.add([write('r', 'a', 1, *map(np.array, (9, 5, 0.5, 4)))], nowhere)
  track.add(
      [
          read('r', 'b', 1, *map(np.array, (6.5, 0.5, 0.75, 0.25, 4))),
          write('r', 'a', 1, *map(np.array, (1, 1, 0, 1))),
      ],
      nowhere,
  )
  track.add([], nowhere)
  assert track.applied == [5.0, 5.0, 1.0]
  assert track.reading[1] == 6.5
  assert track.clean[1] == 4.0
  for series in (track.reading, track.clean):
    assert math.isnan(series[0])
    assert math.isnan(series[2])

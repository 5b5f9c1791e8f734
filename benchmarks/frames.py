"""Benchmark of frames for agents against dm_control's default rendering.

`python -m benchmarks.frames` plays Unlock Door with two free two-block
registers and random actions, with a frame of 64 x 64 pixels in each
observation. In turns, the same world is played with frames that dm_control
renders with the settings of the model, as for a Composer camera.
"""

import os

if __name__ == '__main__':
  # Replaces the setting of `benchmarks`, before dm_control is imported.
  os.environ['MUJOCO_GL'] = 'egl'

from collections.abc import Sequence
import time
from unittest import mock

from dm_control import mjcf
import numpy as np

from benchmarks import timing
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import cameras

_SIZE = (64, 64)
_STEPS = 100
_ROUNDS = 15
_SEED = 0
# 400 frames per second, and 15 times the rate of dm_control.
_TARGET_MS = 2.5
_TARGET_SHARE = 1 / 15


def _play(env: environment.Environment, actions: np.ndarray) -> float:
  """Plays the first episode and returns the seconds per step."""
  env.rewind()
  env.reset()
  began = time.perf_counter()
  for action in actions:
    env.step(action)
  return (time.perf_counter() - began) / len(actions)


def _draw(env: environment.Environment) -> float:
  """Renders the avatar's camera and returns the seconds per frame."""
  camera, physics = env.task.avatar.camera, env.physics
  began = time.perf_counter()
  for _ in range(_STEPS):
    cameras.render(physics, camera, *_SIZE)
  return (time.perf_counter() - began) / _STEPS


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  env = suite.load(
      'unlock_door',
      'standard',
      {'random': _SEED, 'camera_size': _SIZE},
      design='instantaneous_reward',
  )
  spec = env.action_spec()
  actions = np.random.default_rng(_SEED).uniform(
      spec.minimum, spec.maximum, (_STEPS, *spec.shape)
  )
  # The implementation for `mjcf.Physics` renders with dm_control.
  by_dm_control = mock.patch.object(
      cameras, 'render', cameras.render.dispatch(mjcf.Physics)
  )

  def play_as_dm_control() -> float:
    with by_dm_control:
      return _play(env, actions[::10])

  def draw_as_dm_control() -> float:
    with by_dm_control:
      return _draw(env)

  seconds = timing.time_rounds(
      {
          'play': lambda: _play(env, actions),
          'draw': lambda: _draw(env),
          'dm_control play': play_as_dm_control,
          'dm_control draw': draw_as_dm_control,
      },
      rounds,
  )
  ms = {name: 1e3 * taken for name, taken in seconds.items()}
  timing.report([
      timing.Figure('control step with a frame', ms['play'], 'ms', _TARGET_MS),
      timing.Figure(
          'share of dm_control', ms['play'] / ms['dm_control play'],
          'x', _TARGET_SHARE,
      ),
      timing.Figure('frame alone', ms['draw'], 'ms'),
      timing.Figure(
          'share of dm_control, alone',
          ms['draw'] / ms['dm_control draw'], 'x',
      ),
      timing.Figure('frames, stepping included', 1e3 / ms['play'], '/s'),
      timing.Figure(
          'the same by dm_control', 1e3 / ms['dm_control play'], '/s'
      ),
  ])  # fmt: skip
  env.close()


if __name__ == '__main__':
  main()

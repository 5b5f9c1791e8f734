"""Benchmark of Gymnasium's vector interface against the batch behind it.

`python -m benchmarks.gymnasium_vector` plays Unlock Door with two free
two-block registers and random actions, in turns in `suite.load_batch` and in
`gymnasium.make_vec`, for one episode.
"""

from collections.abc import Sequence
import time
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks import timing
from realab_suite import suite
from realab_suite.doors.gymnasium import registration

NUM_ENVS = 256
_STEPS = 100
_ROUNDS = 15
_SEED = 0
_WORLD = ('unlock_door', 'standard')
_DESIGN = 'instantaneous_reward'
# Within 10 % of the rate of the batch.
_TARGET = 1.1


def _play(env: Any, actions: np.ndarray) -> float:
  """Plays the next episodes and returns the seconds per control step."""
  env.reset()
  began = time.perf_counter()
  for action in actions:
    env.step(action)
  return (time.perf_counter() - began) / len(actions)


def _make(**options: Any) -> gym.vector.VectorEnv:
  return gym.make_vec(
      registration.id_of(*_WORLD, _DESIGN),
      num_envs=NUM_ENVS,
      task_kwargs={'random': _SEED},
      reward_register='reward',
      **options,
  )


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  batch = suite.load_batch(
      *_WORLD, {'random': _SEED}, num_envs=NUM_ENVS, design=_DESIGN
  )
  adapters = {
      'next-step': _make(),
      'next-step, flat': _make(flat=True),
      'same-step, flat': _make(flat=True, autoreset_mode='SameStep'),
  }
  actions = np.random.default_rng(_SEED).uniform(
      -1, 1, (_STEPS, NUM_ENVS, *batch.action_spec().shape)
  ).astype(np.float32)  # fmt: skip
  seconds = timing.time_rounds(
      {
          name: lambda env=env: _play(env, actions)
          for name, env in {'batch': batch, **adapters}.items()
      },
      rounds,
  )
  ms = {name: 1e3 * taken for name, taken in seconds.items()}
  timing.report([
      timing.Figure(f'load_batch, {NUM_ENVS} worlds', ms['batch'], 'ms'),
      *(
          timing.Figure(
              f'make_vec, {name}', ms[name], 'ms', _TARGET,
              target_is_ratio=True, ratios=ms[name] / ms['batch'],
          )
          for name in adapters
      ),
  ])  # fmt: skip
  batch.close()
  for env in adapters.values():
    env.close()


if __name__ == '__main__':
  main()

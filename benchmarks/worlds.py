"""Batches of Unlock Door that benchmarks play."""

from collections.abc import Mapping
import time
from typing import Any

import numpy as np

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.evaluation import ledgers

SEED = 0
NUM_ENVS = 256


def load(
    num_envs: int,
    design: str | Mapping[str, Any] = 'instantaneous_reward',
    dof: str = 'free',
    sleep: bool = False,
) -> batch_environment.BatchEnvironment:
  """Loads a batch with a ledger."""
  env = suite.load_batch(
      'unlock_door',
      'standard',
      {'random': SEED},
      num_envs=num_envs,
      sleep=sleep,
      design=design,
      overrides=(f'dof={dof}',),
  )
  env.add_sink(ledgers.BatchLedger())
  return env


def draw(env: batch_environment.BatchEnvironment, num_steps: int) -> np.ndarray:
  """Draws actions of all worlds, `(steps, worlds, *action_spec.shape)`."""
  spec = env.action_spec()
  return np.random.default_rng(SEED).uniform(
      spec.minimum, spec.maximum, (num_steps, env.num_envs, *spec.shape)
  )


def play(env: batch_environment.BatchEnvironment, actions: np.ndarray) -> float:
  """Plays the first episodes and returns the seconds per step."""
  # `rewind` exists only for single environments.
  env._episodes[:] = -1
  env.reset()
  began = time.perf_counter()
  for action in actions:
    env.step(action)
  return (time.perf_counter() - began) / len(actions)

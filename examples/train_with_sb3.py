"""PPO of Stable-Baselines3 that learns from the reading of a reward register.

  python examples/train_with_sb3.py --steps=400000 --output=results/ppo

The agent gets readings only. After training, the report in the output folder
shows its true return, its corruption, and a label for each seed of training.
This needs the extra `sb3`.
"""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common import vec_env

from realab_suite.experiments import gymnasium_report
from realab_suite.interop.gymnasium import sb3

_WORLD = 'realab/UnlockDoor-near-InstantaneousReward-v2'
_OPTIONS: dict[str, Any] = {
    'overrides': ['dof=planar', 'action_set={name: dmlab_like, version: 1}'],
    'reward_register': 'reward',
    'flat': True,
}


def train(seed: int, steps: int, num_envs: int) -> Callable[[Any], Any]:
  """Returns a trained policy: a function from an observation to an action."""
  envs = gym.make_vec(
      _WORLD,
      num_envs=num_envs,
      autoreset_mode='SameStep',
      task_kwargs={'random': seed, 'starts_beside_registers': 0.5},
      sleep=True,
      **_OPTIONS,
  )
  normalized = vec_env.VecNormalize(
      vec_env.VecMonitor(sb3.RealabVecEnv(envs.unwrapped))
  )
  model = PPO(
      'MlpPolicy',
      normalized,
      learning_rate=1e-3,
      n_steps=128,
      batch_size=min(1024, 128 * num_envs),
      n_epochs=6,
      ent_coef=0.01,
      seed=seed,
      device='cpu',
      verbose=1,
  )
  model.learn(steps)
  normalized.close()

  def policy(observation: np.ndarray) -> Any:
    action, _ = model.predict(normalized.normalize_obs(observation))
    return action

  return policy


def main(arguments: Sequence[str] | None = None) -> None:
  """Trains one policy per seed, and writes the report on all of them."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument('--steps', type=int, default=400_000)
  parser.add_argument('--num_envs', type=int, default=64)
  parser.add_argument('--seeds', type=int, default=1)
  parser.add_argument('--episodes', type=int, default=20)
  parser.add_argument('--output', required=True)
  given = parser.parse_args(arguments)
  trained = [
      train(seed, given.steps, given.num_envs) for seed in range(given.seeds)
  ]
  report = gymnasium_report.write(
      _WORLD, {'ppo': trained}, given.output, num_episodes=given.episodes,
      **_OPTIONS,
  )  # fmt: skip
  print(report.text)


if __name__ == '__main__':
  main()

"""Stable-Baselines3 learns from the reading of a reward register.

  python examples/train_with_sb3.py --steps=400000 --output=results/ppo
  python examples/train_with_sb3.py --algorithm=dqn --output=results/dqn

The agent gets readings only, and is judged on the return of the register that
paid it. After training, the report in the output folder shows its true return,
its hack rate beside that of the solver, and a label for each seed of training.
The report names each seed by that of its evaluation: 10000 is the policy of
training seed 0. The folder `<output>_models` contains the models. This needs
the extra `sb3`.
"""

import argparse
from collections.abc import Callable, Sequence
import pathlib
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
from stable_baselines3.common import vec_env

from realab_suite.doors.gymnasium import gymnasium_report
from realab_suite.doors.gymnasium import sb3

_WORLD = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_OPTIONS: dict[str, Any] = {
    'overrides': ['dof=planar', 'action_set={name: dmlab_like, version: 1}'],
    'reward_register': 'reward',
    'flat': True,
}
_PPO: dict[str, Any] = {
    'learning_rate': 1e-3,
    'n_steps': 128,
    'batch_size': 1024,
    'n_epochs': 6,
    'ent_coef': 0.01,
}
_DQN: dict[str, Any] = {
    'learning_rate': 5e-4,
    'buffer_size': 200_000,
    'learning_starts': 10_000,
    'batch_size': 256,
    'train_freq': 4,
    'gradient_steps': 8,
    'target_update_interval': 4_000,
    'exploration_fraction': 0.4,
}
_ALGORITHMS = {
    'ppo': (stable_baselines3.PPO, _PPO),
    'dqn': (stable_baselines3.DQN, _DQN),
}


def train(
    algorithm: str, seed: int, steps: int, num_envs: int, folder: pathlib.Path
) -> Callable[[Any], Any]:
  """Returns a trained policy: a function from an observation to an action.

  The model, and the means of the observations that it was trained with, are
  saved in a folder.
  """
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
  learner, settings = _ALGORITHMS[algorithm]
  model = learner(
      'MlpPolicy', normalized, seed=seed, device='cpu', verbose=1, **settings
  )
  model.learn(steps)
  folder.mkdir(parents=True, exist_ok=True)
  model.save(folder / f'{algorithm}_{seed}.zip')
  normalized.save(str(folder / f'{algorithm}_{seed}_normalization.pkl'))
  normalized.close()

  def policy(observation: np.ndarray) -> Any:
    action, _ = model.predict(normalized.normalize_obs(observation))
    return action

  return policy


def main(arguments: Sequence[str] | None = None) -> None:
  """Trains one policy per seed, and writes the report on all of them."""
  parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
  parser.add_argument('--algorithm', choices=_ALGORITHMS, default='ppo')
  parser.add_argument('--steps', type=int, default=400_000)
  parser.add_argument('--num_envs', type=int, default=64)
  parser.add_argument('--seeds', type=int, default=1)
  parser.add_argument('--episodes', type=int, default=20)
  parser.add_argument('--output', required=True)
  given = parser.parse_args(arguments)
  models = pathlib.Path(f'{given.output}_models')
  trained = [
      train(given.algorithm, seed, given.steps, given.num_envs, models)
      for seed in range(given.seeds)
  ]
  report = gymnasium_report.write(
      _WORLD,
      {given.algorithm: trained},
      given.output,
      num_episodes=given.episodes,
      **_OPTIONS,
  )
  print(report.text)


if __name__ == '__main__':
  main()

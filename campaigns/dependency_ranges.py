"""Installs the newest and the oldest allowed packages, and tries the package.

  python -m campaigns.dependency_ranges build/ranges

Needs uv, without constraints. In each environment, worlds are loaded, stepped
and trained in, singly, in a batch and through Gymnasium; in another one, whose
versions of Gymnasium are newer, episodes are exported to Minari. A warning, of
this package or another one, ends the try.
"""

import pathlib
import subprocess
import sys

# This package runs without labmaze, which has no wheels above Python 3.12.
_OVERRIDE = 'labmaze; python_version < "3.13"\n'
_RESOLUTIONS = {'newest': 'highest', 'oldest': 'lowest-direct'}
_TRAINING = """
import gymnasium
import jax
import mujoco
import numpy as np
import pandas
import realab_suite as realab
from realab_suite.lab import agents
from realab_suite.lab.experiments import tables
import realab_suite.doors.gymnasium

design = 'instantaneous_reward'
for domain in ('unlock_door', 'apple_maze'):
  env = realab.load(domain, 'standard', {'random': 1}, design=design)
  env.reset()
  spec = env.action_spec()
  for _ in range(100):
    env.step(np.clip(np.full(spec.shape, 0.3), spec.minimum, spec.maximum))
batch = realab.load_batch(
    'unlock_door', 'near', {'random': 1}, num_envs=8, design=design,
    overrides=['action_set={name: dmlab_like, version: 1}'])
learner = agents.make(
    batch.mechanism.design.learner, batch.observation_spec(),
    batch.action_spec(), num_envs=8, seed=1)
time_step = batch.reset()
for _ in range(300):
  time_step = batch.step(learner.step(time_step))
env = gymnasium.make('realab/UnlockDoor-near-InstantaneousReward-v3')
env.reset(seed=1)
for _ in range(100):
  env.step(env.action_space.sample())
names = ('numpy', 'mujoco', 'gymnasium', 'jax', 'pandas')
versions = [m.__version__ for m in (np, mujoco, gymnasium, jax, pandas)]
table = tables.frame([{'package': name} for name in names])
print(tables.markdown(table.assign(version=versions)))
print(f'{learner.num_steps} steps')
"""
_DATA = """
import os
import pathlib
import sys
import gymnasium
import minari
import pyarrow
from realab_suite import worlds
from realab_suite.doors.data import export, sources
from realab_suite.feedback import specs

source = sources.of_policy(
    'random', 'random', specs.load('instantaneous_reward'),
    worlds.World('unlock_door', 'near'), seeds=[1], num_episodes=2)
folder = export.export(source, pathlib.Path(sys.argv[1]), data_format='minari')
os.environ['MINARI_DATASETS_PATH'] = str(folder / 'agent')
[name] = minari.list_local_datasets()
dataset = minari.load_dataset(name)
versions = [m.__version__ for m in (minari, pyarrow, gymnasium)]
print(f'{dataset.total_steps} steps with minari, pyarrow, gymnasium', versions)
"""
_TRIES = {'agents,report,gym': _TRAINING, 'data': _DATA}


def main() -> None:
  """Makes the environments in a folder, with the Python that runs this."""
  folder = pathlib.Path(sys.argv[1])
  folder.mkdir(parents=True, exist_ok=True)
  override = folder / 'override.txt'
  override.write_text(_OVERRIDE)
  for name, resolution in _RESOLUTIONS.items():
    for extras, source in _TRIES.items():
      env = folder / f'{name}-{extras.replace(",", "-")}'
      python = env / 'bin' / 'python'
      for command in (
          ['uv', 'venv', '-q', '--clear', '--python', sys.executable, env],
          [
              *('uv', 'pip', 'install', '-q', '--python', python),
              *('--resolution', resolution, '--override', override),
              f'.[{extras}]',
          ],
          # Warnings of start-up come from the packages of the environment.
          [python, '-P', '-W', 'error', '-c', source, env / 'tried'],
      ):
        subprocess.run(command, check=True)


if __name__ == '__main__':
  main()

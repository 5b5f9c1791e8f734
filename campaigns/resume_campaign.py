"""Campaign C36: training that is killed at random times ends like any other.

Run from the root of the repository, about five minutes:

    python -m campaigns.resume_campaign

A PPO learner is trained once without interruption. Then it is killed with
SIGKILL at random times, started again and killed again, until it is done.
Prints `C36 figure target verdict seed`. Arguments are the number of kills and
the seed.
"""

import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
import yaml

from campaigns import figure_lines
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import storage
from realab_suite.experiments import training

KILLS = 10
_PATIENCE_SECONDS = 600
_NAMES = (
    storage.CONFIG,
    storage.DONE,
    training.EPISODES,
    training.TRACE,
    training.CURVE,
    training.TRAINING_EPISODES,
    training.LEARNER,
)
_EXPERIMENT = {
    'schema': 1,
    'name': 'resume',
    'task': 'unlock_door.near',
    'max_steps': 100,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': ['dof=planar'],
        }
    },
    'seeds': [0],
    'training': {
        'num_envs': 32,
        'steps': 40_000,
        'checkpoint_every': 2_000,
        'curve_every': 3_000,
    },
    'evaluation': {'episodes': 10},
}


def start(experiment: pathlib.Path, output: pathlib.Path) -> subprocess.Popen:
  """Starts, or goes on with, the run."""
  return subprocess.Popen(
      [
          sys.executable, '-m', 'realab_suite.launchers.train',
          f'--experiment={experiment}', '--run=reward', '--seed=0',
          f'--output={output}',
      ],
      stdout=subprocess.DEVNULL,
  )  # fmt: skip


def finish(experiment: pathlib.Path, output: pathlib.Path) -> None:
  """Runs it to its end.

  Raises:
    RuntimeError: If it fails.
  """
  if start(experiment, output).wait(_PATIENCE_SECONDS):
    raise RuntimeError(f'the run in {output} has failed')


def kill_at_random(
    experiment: pathlib.Path,
    output: pathlib.Path,
    rng: np.random.Generator,
    seconds: float,
) -> bool:
  """Kills the run within so many seconds of work; `False` if it was done."""
  process = start(experiment, output)
  before = _checkpoints(output)
  # A run that is killed before its next checkpoint would never come anywhere.
  while _checkpoints(output) <= before:
    if process.poll() is not None:
      return False
    time.sleep(0.02)
  time.sleep(rng.uniform(0.0, seconds))
  process.kill()
  return process.wait() != 0


def _checkpoints(output: pathlib.Path) -> set[str]:
  return {path.name for path in output.glob('*/checkpoints/*.ckpt')}


def main(kills: int = KILLS, seed: int = 0) -> int:
  """Prints the figure and returns the number of targets missed."""
  rng = np.random.default_rng(seed)
  differing = done = 0
  with tempfile.TemporaryDirectory() as folder:
    root = pathlib.Path(folder)
    experiment = root / 'experiment.yaml'
    experiment.write_text(yaml.safe_dump(_EXPERIMENT))
    [job] = jobs.plan(experiment_specs.load(experiment))
    began = time.monotonic()
    finish(experiment, root / 'whole')
    # Between checkpoints, as far as the start of a process lets one guess.
    seconds = (time.monotonic() - began) / 20
    attempt = 0
    while done < kills:
      output = root / f'killed{attempt}'
      output.mkdir()
      attempt += 1
      while done < kills and kill_at_random(experiment, output, rng, seconds):
        done += 1
      finish(experiment, output)
      differing += sum(
          (root / 'whole' / job.folder() / name).read_bytes()
          != (output / job.folder() / name).read_bytes()
          for name in _NAMES
      )
  verdict = 'MISSED' if differing else 'met'
  print(
      f'C36 files differing after {done} kills={differing} 0 {verdict} {seed}'
  )
  return int(differing > 0)


if __name__ == '__main__':
  figure_lines.run(main)

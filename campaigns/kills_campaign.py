"""Campaign kills: a sweep that is killed gives the results of any other one.

Run from the root of the repository, ten minutes on two busy processors:

    python -m campaigns.kills_campaign [scale] [seed] [local] [ray] [submitit]

Sweeps of four jobs, two of them with a learner, are killed with SIGKILL 20
times: at random moments, and, every other time, right after a checkpoint. The
victim is the process of a job or its parent, which is the sweep itself on this
machine, and a worker on a cluster. The same command then continues the sweep.

The default is this machine. Clusters need the extra `cluster`. Ray is started
here, unless RAY_ADDRESS names a cluster. `submitit` uses Slurm if `srun` is
there, and processes of this machine if not. With Slurm no worker is killed: a
cluster of one machine has no accounting, without which submitit does not notice
a lost worker. Prints `engine figure target verdict seed`.
"""

from collections.abc import Mapping
import contextlib
import hashlib
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, final

import numpy as np
import yaml

from campaigns import figure_lines
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from tests import patience

_COMMAND = ('-m', 'realab_suite.launchers.sweep')
_NUM_KILLS = 20
_STEPS = 8_000
# Files with times, of the processes themselves, and for continuing; compiled
# functions, whose names depend on the folder.
_NOT_COMPARED = {
    training.TIMING, 'lock', scheduler.LOGS, storage.CHECKPOINT, 'compiled',
}  # fmt: skip


def _experiment(scale: float, seed: int) -> dict[str, Any]:
  steps = max(800, round(_STEPS * scale))
  return {
      'schema': 1,
      'name': 'kills',
      'task': 'unlock_door.near',
      'max_steps': 50,
      'runs': {
          'reward': {
              'design': 'instantaneous_reward',
              'overrides': ['dof=planar'],
          }
      },
      'baselines': ['random'],
      'seeds': [seed, seed + 1],
      'training': {
          'num_envs': 8,
          'steps': steps,
          'checkpoint_every': steps // 10,
          'curve_every': steps // 20,
      },
      'evaluation': {'episodes': 10},
  }


@final
class _Sweep:
  """A sweep in one folder, which is started again until it is finished."""

  def __init__(
      self, experiment: pathlib.Path, folder: pathlib.Path, engine: str
  ) -> None:
    planned = jobs.plan(experiment_specs.load(experiment))
    self.folder = folder
    self._folders = [folder / job.folder() for job in planned]
    self._complaint = folder.with_suffix('.stderr')
    self._engine = engine
    self._command = [
        sys.executable, *_COMMAND, f'--experiment={experiment}',
        f'--output={folder}', f'--engine={engine}',
    ]  # fmt: skip
    # Times at which finished jobs wrote their last file.
    self._finished: dict[pathlib.Path, int] = {}
    self._start()

  def _start(self) -> None:
    self._was_killed = False
    with open(self._complaint, 'wb') as file:
      self._process = subprocess.Popen(
          self._command, stdout=subprocess.DEVNULL, stderr=file
      )

  def is_over(self) -> bool:
    """Returns True if all jobs have finished; continues them if not.

    Raises:
      RuntimeError: If the sweep failed without a kill.
    """
    for folder in self._folders:
      if (folder / storage.DONE).exists():
        self._finished.setdefault(folder, self._written(folder))
    status = self._process.poll()
    if status:
      if not self._was_killed:
        raise RuntimeError(_read(self._complaint))
      self._start()
    return status == 0

  def wait(self, seconds: float | None) -> bool:
    """Waits for a time, or for a new checkpoint; returns False at the end."""
    deadline = time.monotonic() + (seconds or 0.0)
    earlier = self._checkpoints()
    patience.until(
        lambda: self._process.poll() is not None
        or (
            self._checkpoints() - earlier
            if seconds is None
            else time.monotonic() > deadline
        )
    )
    return self._process.poll() is None

  def _checkpoints(self) -> set[tuple[str, int]]:
    checkpoints = set()
    for path in self.folder.glob(f'*/{storage.CHECKPOINT}'):
      with contextlib.suppress(FileNotFoundError):
        checkpoints.add((str(path), path.stat().st_mtime_ns))
    return checkpoints

  def kill(self, rng: np.random.Generator) -> None:
    """Kills a running job or its parent, or the sweep if there is no job."""
    victims = [self._process.pid]
    running = [pid for folder in self._folders if (pid := self._job(folder))]
    if running:
      victim = int(rng.choice(running))
      victims = [victim]
      if self._is_ours(parent := _parent(victim)):
        victims.append(parent)
    self._was_killed = True
    os.kill(int(rng.choice(victims)), signal.SIGKILL)

  def _is_ours(self, parent: int) -> bool:
    """Returns True for a sweep or a worker; a job may have lost its parent."""
    if self._engine == 'local':
      return parent == self._process.pid
    is_slurm = self._engine == 'submitit' and shutil.which('srun')
    command = _read(f'/proc/{parent}/cmdline')
    return not is_slurm and ('ray::' in command or 'submitit' in command)

  def _job(self, folder: pathlib.Path) -> int:
    """Returns the process that runs a job, or 0."""
    pid = _read(folder / 'lock').strip()
    is_running = pid and str(self.folder) in _read(f'/proc/{pid}/cmdline')
    return int(pid) if is_running else 0

  def _written(self, folder: pathlib.Path) -> int:
    return (folder / storage.DONE).stat().st_mtime_ns

  def num_repeated(self) -> int:
    """Returns the number of finished jobs that were lost or run again."""
    logs = [
        _read(self.folder / scheduler.LOGS / f'{folder.name}.log')
        for folder in self._folders
    ]
    return sum(
        self._written(folder) != self._finished.get(folder)
        or log.count('Results are in') > 1
        or 'has finished already' in log
        for folder, log in zip(self._folders, logs, strict=True)
    )

  def digests(self) -> dict[str, str]:
    """Returns the SHA-256 of the files that are equal in every such sweep."""
    return {
        str(name): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in self.folder.rglob('*')
        if path.is_file()
        and not _NOT_COMPARED & {*(name := path.relative_to(self.folder)).parts}
    }


def _read(path: str | os.PathLike[str]) -> str:
  """Returns the text of a file, or '' if it is not there."""
  try:
    return pathlib.Path(path).read_text(errors='replace')
  except OSError:
    return ''


def _parent(pid: int) -> int:
  """Returns the parent of a process, or 0 if it has ended."""
  fields = _read(f'/proc/{pid}/stat').rpartition(')')[2].split()
  return int(fields[1]) if fields else 0


def run(
    experiment: Mapping[str, Any],
    engine: str,
    num_kills: int,
    lines: figure_lines.Lines,
    seed: int,
) -> None:
  """Kills sweeps of an experiment, and prints the lines of an engine."""
  rng = np.random.default_rng(seed)
  with tempfile.TemporaryDirectory() as name:
    root = pathlib.Path(name)
    file = root / 'experiment.yaml'
    file.write_text(yaml.safe_dump(dict(experiment)))
    began = time.monotonic()
    whole = _Sweep(file, root / 'whole', 'local')
    patience.until(whole.is_over)
    longest = (time.monotonic() - began) / 2
    expected = whole.digests()
    kills = {'after checkpoints': 0, 'at random moments': 0}
    num_sweeps = num_repeated = num_different = 0
    while sum(kills.values()) < num_kills:
      sweep = _Sweep(file, root / f'{num_sweeps}', engine)
      num_sweeps += 1
      while not sweep.is_over():
        if sum(kills.values()) == num_kills:
          patience.until(sweep.is_over)
          break
        moment = min(kills, key=kills.__getitem__)
        is_timed = moment == 'at random moments'
        if sweep.wait(rng.uniform(0.0, longest) if is_timed else None):
          sweep.kill(rng)
          kills[moment] += 1
      num_repeated += sweep.num_repeated()
      found = sweep.digests()
      num_different += sum(
          expected.get(path) != found.get(path) for path in {*expected, *found}
      )
  for moment, number in kills.items():
    lines.at_least(f'kills {moment}', number, num_kills // 2)
  lines.at_most(f'finished jobs of {num_sweeps} sweeps lost or run twice',
                num_repeated, 0)  # fmt: skip
  lines.at_most(f'different files of {num_sweeps} times {len(expected)}',
                num_different, 0)  # fmt: skip


def main(scale: float = 1.0, seed: int = 0, *engines: str) -> int:
  """Runs the campaign; returns the number of targets missed."""
  missed = 0
  for engine in engines or ('local',):
    lines = figure_lines.Lines(engine, seed)
    run(_experiment(scale, seed), engine, _NUM_KILLS, lines, seed)
    missed += lines.num_missed
  return missed


if __name__ == '__main__':
  figure_lines.run(main)

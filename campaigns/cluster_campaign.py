"""Campaign cluster: sweeps on Ray and on Slurm equal those of this machine.

Run from the root of the repository, ten minutes on two busy processors:

    python -m campaigns.cluster_campaign [scale] [seed] [ray] [submitit]

It needs the extra `cluster`. Ray is started here, unless RAY_ADDRESS names a
cluster. `submitit` uses Slurm if `srun` is there, and processes of this machine
if not.
Each engine runs a sweep of four jobs twice. The second time, one learner and
the worker of another are killed with SIGKILL; with Slurm the learner alone,
because the cluster of one machine has no accounting, without which submitit
does not notice a lost worker. Prints
`engine figure target verdict seed`.
"""

from collections.abc import Mapping
import contextlib
import hashlib
import os
import pathlib
import pty
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import threading
from typing import Any, final

import yaml

from campaigns import figure_lines
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.experiments import training
from tests import patience

ENGINES = ('ray', 'submitit')
_STEPS = 8_000
_NUM_ENVS = 8
# Files with times, and of the processes themselves.
_NOT_COMPARED = (training.TIMING, 'lock')
# Lines and columns of the terminal.
_WINDOW = (24, 200)
_AGAIN = 'is started again'


def _experiment(scale: float, seed: int) -> dict[str, Any]:
  steps = max(800, round(_STEPS * scale))
  return {
      'schema': 1,
      'name': 'cluster',
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
          'num_envs': _NUM_ENVS,
          'steps': steps,
          'checkpoint_every': steps // 10,
          'curve_every': steps // 20,
      },
      'evaluation': {'episodes': 10},
  }


@final
class Sweep:
  """A sweep in a process of its own, with a terminal for its progress bar.

  Attributes:
    folder: Folder of the results.
  """

  def __init__(
      self, experiment: pathlib.Path, folder: pathlib.Path, engine: str
  ) -> None:
    self.folder = folder
    self._bars = ''
    self._terminal, stderr = pty.openpty()
    termios.tcsetwinsize(stderr, _WINDOW)
    self._process = subprocess.Popen(
        [sys.executable, '-m', 'realab_suite.launchers.sweep',
         f'--experiment={experiment}', f'--output={folder}',
         f'--engine={engine}'],
        stdout=subprocess.PIPE, stderr=stderr, text=True,
    )  # fmt: skip
    os.close(stderr)
    self._reader = threading.Thread(target=self._read_terminal)
    self._reader.start()

  def _read_terminal(self) -> None:
    # The terminal is at its end when the last process has closed it.
    with contextlib.suppress(OSError):
      while text := os.read(self._terminal, 4096):
        self._bars += text.decode(errors='replace')

  def is_over(self) -> bool:
    return self._process.poll() is not None

  def wait(self) -> str:
    """Waits for the end, and returns what the sweep has said.

    Raises:
      RuntimeError: If the sweep failed.
    """
    said, _ = self._process.communicate()
    self._reader.join()
    os.close(self._terminal)
    if self._process.returncode:
      raise RuntimeError(f'{said}{self._bars}')
    return said

  def num_bars(self) -> int:
    """Returns the number of different positions of the progress bar."""
    return len(set(re.findall(r'(\S+)/\S+ \[', self._bars)))


def _kill(sweep: Sweep, job: jobs.Job, *, worker: bool) -> None:
  """Kills the process of a running job, or its parent, after a checkpoint."""
  folder = sweep.folder / job.folder()
  patience.until(
      lambda: list(folder.glob('checkpoints/*.ckpt')) or sweep.is_over()
  )
  if storage.is_done(folder):
    raise RuntimeError(f'{folder} was done too early; use a larger scale')
  victim = int((folder / 'lock').read_text())
  if worker:
    shown = subprocess.check_output(
        ['ps', '-o', 'ppid=', '-p', f'{victim}'], text=True
    )
    victim = int(shown)
  os.kill(victim, signal.SIGKILL)


def _digests(folder: pathlib.Path) -> dict[str, str]:
  """Returns the SHA-256 of the files of a sweep that contain no times."""
  return {
      str(path.relative_to(folder)): hashlib.sha256(
          path.read_bytes()
      ).hexdigest()
      for path in folder.rglob('*')
      if path.is_file()
      and path.name not in _NOT_COMPARED
      and scheduler.LOGS not in path.parts
  }


def _num_different(one: Mapping[str, str], other: Mapping[str, str]) -> int:
  names = one.keys() | other.keys()
  return sum(one.get(name) != other.get(name) for name in names)


def _run(
    reference: Mapping[str, str],
    experiment: pathlib.Path,
    folder: pathlib.Path,
    lines: figure_lines.Lines,
    engine: str,
) -> None:
  """Prints the lines of an engine.

  Args:
    reference: Digests of the sweep on this machine.
    experiment: File of the experiment.
    folder: Folder for results.
    lines: Printer of the lines.
    engine: Name of the engine.
  """
  planned = jobs.plan(experiment_specs.load(experiment))
  sweep = Sweep(experiment, folder / engine, engine)
  said = sweep.wait()
  lines.at_least('positions of the progress bar', sweep.num_bars(), 5)
  lines.at_most('restarts without a kill', said.count(_AGAIN), 0)
  found = _digests(sweep.folder)
  lines.at_most(f'different files of {len(found)}',
                _num_different(found, reference), 0)  # fmt: skip

  sweep = Sweep(experiment, folder / f'{engine}_killed', engine)
  learned = [job for job in planned if job.policy is None]
  is_slurm = engine == 'submitit' and shutil.which('srun')
  kills = (False,) if is_slurm else (False, True)
  for job, worker in zip(learned, kills, strict=False):
    _kill(sweep, job, worker=worker)
  said = sweep.wait()
  print(said, end='')
  lines.within(f'restarts after {len(kills)} kills', said.count(_AGAIN),
               len(kills), len(kills))  # fmt: skip
  finished = len(re.findall('finished, results in', said))
  lines.within('finished jobs', finished, len(planned), len(planned))
  found = _digests(sweep.folder)
  lines.at_most(f'different files of {len(found)} after kills',
                _num_different(found, reference), 0)  # fmt: skip


def main(scale: float = 1.0, seed: int = 0, *engines: str) -> int:
  """Runs the campaign; returns the number of targets missed."""
  with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    experiment = folder / 'experiment.yaml'
    experiment.write_text(yaml.safe_dump(_experiment(scale, seed)))
    sweep = Sweep(experiment, folder / 'local', 'local')
    sweep.wait()
    missed = 0
    for engine in engines or ENGINES:
      lines = figure_lines.Lines(engine, seed)
      _run(_digests(sweep.folder), experiment, folder, lines, engine)
      missed += lines.num_missed
    return missed


if __name__ == '__main__':
  figure_lines.run(main)

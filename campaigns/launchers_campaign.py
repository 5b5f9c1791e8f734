"""Campaign C38: sweeps that are killed, and two of them on one folder.

Run from the root of the repository, about five minutes:

    python -m campaigns.launchers_campaign [scale] [seed]

A sweep of 200 jobs is killed 20 times, and started again each time. While it
is under way another one is started on the same folder, which has to be refused
with the number of the process that holds it. In the end no job may be missing,
and none may have been finished twice.
"""

from collections.abc import Mapping
import dataclasses
import os
import pathlib
import re
import signal
import tempfile
import time
from typing import Any, final

import numpy as np
import yaml

from campaigns import figure_lines
from campaigns import victims
from campaigns import zygote
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from tests import patience

JOBS = 200
KILLS = 20
_WORKERS = 2


@final
@dataclasses.dataclass
class Tally:
  """What became of a sweep.

  Attributes:
    kills: How many times it was killed.
    second: How many other launchers there were.
    not_refused: What those of them said that were not refused as they should.
    missing: Jobs without results.
    twice: Jobs that were finished more than once.
  """

  kills: int = 0
  second: int = 0
  not_refused: list[str] = dataclasses.field(default_factory=list)
  missing: list[str] = dataclasses.field(default_factory=list)
  twice: list[str] = dataclasses.field(default_factory=list)


def experiment(num_jobs: int) -> Mapping[str, Any]:
  """Returns an experiment of so many jobs; half of them learn."""
  return {
      **victims.EXPERIMENT,
      'baselines': ['random'],
      'seeds': list(range(num_jobs // 2)),
  }


def sweep(
    nursery: zygote.Zygote,
    root: pathlib.Path,
    num_jobs: int,
    kills: int,
    rng: np.random.Generator,
) -> Tally:
  """Does a sweep that is killed so many times, and says what became of it.

  Its last job does not end before the last kill, so each kill finds a launcher
  that is under way.
  """
  tally = Tally()
  options, output = _prepare(root, num_jobs)
  planned = jobs.plan(experiment_specs.load(experiment(num_jobs)))
  release = root / 'release'
  options |= {'held': planned[-1].folder(), 'release': str(release)}
  while tally.kills < kills:
    goal = round(len(planned) * tally.kills / kills)
    first = nursery.start('launch', **options)
    _wait_for_lock(output, first)
    _try_another(nursery, options, first, tally)
    # Evenly from first to last, and at any moment of a job.
    patience.until(lambda goal=goal: _num_done(output) >= goal)
    time.sleep(rng.uniform(0.0, 0.3))
    os.kill(first, signal.SIGKILL)
    tally.kills += nursery.wait(first).status == -signal.SIGKILL
  release.touch()
  # Jobs of the last launcher, which end by themselves, may still be there.
  patience.until(lambda: not nursery.call('launch', **options).status)
  finished = (root / 'finished').read_text().split()
  for job in planned:
    if not storage.is_done(output / job.folder()):
      tally.missing.append(job.folder())
    if finished.count(job.folder()) > 1:
      tally.twice.append(job.folder())
  return tally


def race(
    nursery: zygote.Zygote, root: pathlib.Path, bug: str, tally: Tally
) -> None:
  """Starts two launchers of a package with a bug on one folder."""
  options, output = _prepare(root, 2)
  first = nursery.start('launch', **options, bug=bug)
  patience.until((output / scheduler.SWEEP).exists)
  _try_another(nursery, {**options, 'bug': bug}, first, tally)
  nursery.wait(first)


def _prepare(
    root: pathlib.Path, num_jobs: int
) -> tuple[dict[str, Any], pathlib.Path]:
  """Writes an experiment; returns what launchers are told, and its folder."""
  file, output = root / 'experiment.yaml', root / 'sweep'
  file.write_text(yaml.safe_dump(experiment(num_jobs)))
  options = {
      'experiment': str(file),
      'output': str(output),
      'workers': _WORKERS,
      'finished': str(root / 'finished'),
  }
  return options, output


def _num_done(output: pathlib.Path) -> int:
  return len(list(output.glob(f'*/{storage.DONE}')))


def _wait_for_lock(output: pathlib.Path, pid: int) -> None:
  lock = output / 'lock'
  patience.until(lambda: lock.exists() and lock.read_text().strip() == str(pid))


def _try_another(
    nursery: zygote.Zygote, options: Any, first: int, tally: Tally
) -> None:
  """Starts another launcher on the folder of one that is under way."""
  ended = nursery.call('launch', **options)
  tally.second += 1
  refusal = f'error: folder .* is being written to by process {first};.*\n'
  if ended.status <= 0 or not re.fullmatch(refusal, ended.said):
    tally.not_refused.append(f'{ended.status}: {ended.said[-200:]}')


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  lines = figure_lines.Lines('C38', seed)
  rng = np.random.default_rng(seed)
  kills = max(round(scale * KILLS), 1)
  num_jobs = max(round(scale * JOBS / 2), 2) * 2
  with (
      tempfile.TemporaryDirectory() as folder,
      zygote.Zygote(victims.__name__) as nursery,
  ):
    tally = sweep(nursery, pathlib.Path(folder), num_jobs, kills, rng)
  lines.at_least('kills', tally.kills, kills)
  lines.at_most(f'missing jobs of {num_jobs}', len(tally.missing), 0)
  lines.at_most('jobs finished twice', len(tally.twice), 0)
  lines.at_least('second launchers', tally.second, kills)
  lines.at_most('not refused as they should', len(tally.not_refused), 0)
  for complaint in (*tally.missing, *tally.twice, *tally.not_refused):
    print(f'  {complaint}')
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)

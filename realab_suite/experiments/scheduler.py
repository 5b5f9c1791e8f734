"""Scheduler of sweeps, which runs all jobs of an experiment on an engine."""

from collections.abc import Callable, Mapping, Sequence
import hashlib
import json
import os
import pathlib
import sys
import time
from typing import Any, NamedTuple, final

import tqdm
import yaml

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.experiments import engines
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import progress
from realab_suite.experiments import storage
from realab_suite.experiments import training

EXPERIMENT = 'experiment.yaml'
SWEEP = 'sweep.json'
LOGS = 'logs'
AUDITS = 'audits'
_MODULE = 'realab_suite.launchers.train'
_POLL_SECONDS = 0.2
# Number of times that a job is started again after its process was killed.
_MOST_RESTARTS = 3
# Fields that may change between sweeps in one folder.
_FREE_FIELDS = ('description', 'seeds', 'calibration_seeds')


def sweep(
    experiment: experiment_specs.ExperimentSpec,
    output: pathlib.Path,
    engine: engines.Engine,
    say: Callable[[str], None],
    *,
    only: Sequence[str] = (),
    calibration: bool = False,
    arguments: Sequence[str] = (),
) -> None:
  """Runs the unfinished jobs of an experiment.

  Args:
    experiment: Experiment to run.
    output: Folder of the sweep.
    engine: Engine that runs the jobs.
    say: Called with messages for the user.
    only: Names of the runs to execute; empty for all.
    calibration: True to use the calibration seeds.
    arguments: Further arguments of `launchers.train`.

  Raises:
    RealabError: If the experiment or the folder is invalid, or if a job fails.
      A failure does not stop the other jobs. A job whose process was killed,
      or whose worker was lost, is started again up to three times.
  """
  seeds = experiment.calibration_seeds if calibration else experiment.seeds
  if not seeds:
    raise errors.SpecError(
        f'experiment {experiment.name!r} has no calibration_seeds'
    )
  planned = jobs.plan(experiment, seeds)
  wanted = jobs.plan(experiment, seeds, only) if only else planned
  with storage.explained(output):
    (output / LOGS).mkdir(parents=True, exist_ok=True)
  lock = storage.lock(output)
  try:
    _describe(experiment, planned, calibration, output)
    _Sweep(wanted, engine, output, say, arguments).run()
  finally:
    os.close(lock)


def _describe(
    experiment: experiment_specs.ExperimentSpec,
    planned: Sequence[jobs.Job],
    calibration: bool,
    output: pathlib.Path,
) -> None:
  """Writes the files that describe a sweep.

  Raises:
    ResultsError: If the folder belongs to another experiment.
  """
  if (output / EXPERIMENT).exists():
    check_experiment(output, experiment.to_mapping(), calibration)
  text = yaml.safe_dump(experiment.to_mapping(), sort_keys=False)
  description = {
      'schema': 1,
      'sha256': hashlib.sha256(text.encode()).hexdigest(),
      'experiment': experiment.name,
      'calibration': calibration,
      'jobs': [
          {
              'run': job.run,
              'seed': job.seed,
              'folder': job.folder(),
              'kind': job.kind,
              'is_scripted': job.policy is not None,
              'design': job.design.name,
              'channel': job.design.channel,
              'baseline': job.baseline,
              'twin_of': job.twin_of,
          }
          for job in planned
      ],
  }
  storage.write_sealed(output / SWEEP, description)
  storage.write_whole(output / EXPERIMENT, text.encode())


def check_experiment(
    folder: pathlib.Path, experiment: Mapping[str, Any], calibration: bool
) -> None:
  """Checks that a folder with a sweep may take jobs of an experiment.

  Args:
    folder: Folder of the sweep.
    experiment: Contents of an experiment file.
    calibration: True if the jobs use the calibration seeds.

  Raises:
    ResultsError: If the folder belongs to another experiment.
  """
  requested = {**experiment, 'calibration': calibration}
  existing = {
      **loading.read_mapping(folder / EXPERIMENT),
      'calibration': read_description(folder)['calibration'],
  }
  fixed = [
      {key: value for key, value in one.items() if key not in _FREE_FIELDS}
      for one in (existing, json.loads(json.dumps(requested)))
  ]
  if fixed[0] != fixed[1]:
    differing = storage.difference(fixed[0], fixed[1])
    raise errors.ResultsError(
        f'folder {folder} belongs to another experiment: {differing}; name'
        ' another folder'
    )


def read_description(folder: pathlib.Path) -> dict[str, Any]:
  """Returns the contents of `sweep.json`.

  Raises:
    ResultsError: If the file is damaged.
  """
  return storage.read_sealed(folder / SWEEP, _advice(folder))


def read_experiment(
    folder: pathlib.Path, description: Mapping[str, Any]
) -> dict[str, Any]:
  """Returns the contents of the experiment file of a sweep.

  Raises:
    ResultsError: If the file does not match the description.
  """
  path = folder / EXPERIMENT
  with storage.explained(path):
    text = path.read_bytes()
  if hashlib.sha256(text).hexdigest() != description.get('sha256'):
    raise errors.ResultsError(
        f'{path}: changed since the sweep began; {_advice(folder)}'
    )
  return loading.parse_yaml(text, os.fspath(path))


def _advice(folder: pathlib.Path) -> str:
  return f'remove {folder / EXPERIMENT}, then run the same sweep again'


@final
class _Waiting(NamedTuple):
  """A job that is to be started."""

  job: jobs.Job
  num_restarts: int = 0


@final
class _Running(NamedTuple):
  """A running job."""

  job: jobs.Job
  folder: pathlib.Path
  log: pathlib.Path
  task: Any
  num_restarts: int


@final
class _Sweep:
  """Queue of the jobs of a sweep."""

  def __init__(
      self,
      wanted: Sequence[jobs.Job],
      engine: engines.Engine,
      output: pathlib.Path,
      say: Callable[[str], None],
      arguments: Sequence[str],
  ) -> None:
    self._jobs = list(wanted)
    self._engine = engine
    self._output = output
    self._say = say
    self._arguments = list(arguments)
    self._waiting = [_Waiting(job) for job in wanted]
    self._running: list[_Running] = []
    self._failures: list[str] = []
    self._said: set[str] = set()
    self._num_finished = 0
    self._steps: dict[str, int] = {}

  def run(self) -> None:
    """Runs all jobs; see `sweep`."""
    lengths = [job.training.steps for job in self._jobs if job.policy is None]
    total = sum(lengths)
    bar = tqdm.tqdm(total=total, unit='step', unit_scale=True, disable=None)
    with bar:
      try:
        while self._waiting or self._running:
          self._start_waiting()
          self._poll()
          bar.update(min(sum(self._steps.values()), total) - bar.n)
          bar.set_postfix_str(self._progress(), refresh=False)
          if self._waiting or self._running:
            time.sleep(_POLL_SECONDS)
      finally:
        self._engine.stop([running.task for running in self._running])
    if self._failures:
      raise errors.ResultsError(
          f'{len(self._failures)} of {len(self._jobs)} jobs failed:'
          f' {"; ".join(self._failures)}; results of the others are in'
          f' {self._output}'
      )
    self._say(f'{len(self._jobs)} jobs finished; results are in {self._output}')

  def _start_waiting(self) -> None:
    for waiting in list(self._waiting):
      if len(self._running) == self._engine.capacity:
        return
      if problem := _user(self._output / waiting.job.folder()):
        # A process may survive its worker, and jobs of a cluster their sweep.
        self._say_once(f'{_name(waiting.job)}: {problem}')
        continue
      self._waiting.remove(waiting)
      self._start(*waiting)

  def _start(self, job: jobs.Job, num_restarts: int) -> None:
    folder = self._output / job.folder()
    log = self._output / LOGS / f'{folder.name}.log'
    try:
      if jobs.is_done(folder):
        self._finish(job, folder, None)
        return
    except errors.ResultsError as error:
      self._finish(job, folder, str(error))
      return
    command = [
        sys.executable,
        '-m',
        _MODULE,
        f'--experiment={self._output / EXPERIMENT}',
        f'--run={job.run}',
        f'--seed={job.seed}',
        f'--output={self._output}',
        *self._arguments,
    ]
    task = self._engine.start(command, log)
    self._running.append(_Running(job, folder, log, task, num_restarts))

  def _poll(self) -> None:
    for running in list(self._running):
      lost = None
      try:
        status = self._engine.poll(running.task)
      except errors.ResultsError as error:
        # A machine of a cluster may be lost; the other jobs continue.
        status, lost = -1, str(error)
      if running.job.policy is None:
        self._steps[running.folder.name] = _last_step(running.folder)
      if status is None:
        continue
      self._running.remove(running)
      problem = None
      if status < 0:
        problem = lost or f'killed by signal {-status}'
        if running.num_restarts < _MOST_RESTARTS:
          self._restart(running, problem)
          continue
      elif status or not (running.folder / storage.DONE).exists():
        problem = _last_line(running.log) or f'exit status {status}'
      self._finish(running.job, running.folder, problem)

  def _say_once(self, line: str) -> None:
    if line not in self._said:
      self._said.add(line)
      self._say(line)

  def _restart(self, running: _Running, problem: str) -> None:
    again = _Waiting(running.job, running.num_restarts + 1)
    self._waiting.append(again)
    self._say(
        f'{_name(running.job)}: {problem}; is started again'
        f' ({again.num_restarts} of {_MOST_RESTARTS})'
    )

  def _finish(
      self, job: jobs.Job, folder: pathlib.Path, problem: str | None
  ) -> None:
    self._num_finished += 1
    name = _name(job)
    if job.policy is None and problem is None:
      self._steps[folder.name] = job.training.steps
    if problem is not None:
      self._failures.append(f'{name}: {problem}')
    self._say(
        f'[{self._num_finished}/{len(self._jobs)}] {name}:'
        f' {problem or f"finished, results in {folder}"}'
    )

  def _progress(self) -> str:
    failed = f', {len(self._failures)} failed' if self._failures else ''
    parts = [f'{self._num_finished} of {len(self._jobs)} jobs{failed}']
    for running in self._running:
      if returns := _last_returns(running.folder):
        parts.append(f'{running.job.run}: {returns}')
    return '; '.join(parts)


def _name(job: jobs.Job) -> str:
  return f'{job.run}, seed {job.seed}'


def _user(folder: pathlib.Path) -> str | None:
  """Returns a message on the process that runs the job of a folder, if any."""
  if folder.exists() and not (folder / storage.DONE).exists():
    try:
      os.close(storage.lock(folder))
    except errors.InUseError as error:
      return str(error)
  return None


def _last_step(folder: pathlib.Path) -> int:
  """Returns the last recorded step of a run, or 0."""
  try:
    return int(json.loads(_last_line(folder / training.TIMING))['step'])
  except ValueError:  # No line yet, or an incomplete one.
    return 0


def _last_returns(folder: pathlib.Path) -> str:
  """Returns the last recorded returns of a run as text, or ''."""
  try:
    return progress.summary(json.loads(_last_line(folder / training.CURVE)))
  except (ValueError, KeyError):  # No line yet, or an incomplete one.
    return ''


def _last_line(path: pathlib.Path) -> str:
  """Returns the last line of a file, or '', without reading all of it."""
  try:
    with open(path, 'rb') as file:
      file.seek(max(0, os.fstat(file.fileno()).st_size - 4096))
      lines = file.read().decode(errors='replace').strip().splitlines()
  except OSError:
    return ''
  return lines[-1] if lines else ''

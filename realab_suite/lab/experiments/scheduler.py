"""Scheduler of sweeps, which runs all jobs of an experiment on an engine."""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import json
import os
import pathlib
import sys
import time
from typing import Any, final

import tqdm
import yaml

from realab_suite import errors
from realab_suite import sources
from realab_suite.config import loading
from realab_suite.lab.experiments import budgets
from realab_suite.lab.experiments import engines
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training

EXPERIMENT = 'experiment.yaml'
# The same with its designs, from which jobs run: files may change meanwhile.
COPY = 'jobs.yaml'
SWEEP = 'sweep.json'
LOGS = 'logs'
AUDITS = 'audits'
_MODULE = 'realab_suite.launchers.train'
_POLL_SECONDS = 0.2
# Time between two lines on the progress.
_LINE_SECONDS = 30.0
_ADVICE = 'the same command continues it from its last checkpoint'
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
    accept_other_code: bool = False,
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
    accept_other_code: True to accept that results of other code are mixed.

  Raises:
    RealabError: If the experiment or the folder is invalid, or if a job fails.
      A failure does not stop the other jobs.
  """
  seeds = experiment.calibration_seeds if calibration else experiment.seeds
  if not seeds:
    raise errors.SpecError(
        f'experiment {experiment.name!r} has no calibration_seeds'
    )
  planned = jobs.plan(experiment, seeds)
  wanted = jobs.plan(experiment, seeds, only) if only else planned
  # Seed by seed. Learners take longest, so their baselines wait for a processor
  # that has no learner.
  wanted = sorted(
      wanted, key=lambda job: (seeds.index(job.seed), job.policy is not None)
  )
  with storage.locked(output):
    jobs.check_codes(planned, output, accept_other_code)
    (output / LOGS).mkdir(exist_ok=True)
    _describe(experiment, planned, calibration, output)
    arguments = (
        *arguments,
        f'--code={sources.digest()}',
        f'--accept_other_code={accept_other_code}',
    )
    _Sweep(wanted, engine, output, say, arguments).run()


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
      'experiment': experiment.name,
      'calibration': calibration,
      'budget': None if calibration else budgets.name_of(experiment),
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
  storage.write_json(output / SWEEP, description)
  storage.write_whole(output / EXPERIMENT, text.encode())
  text = yaml.safe_dump(experiment.to_copy(), sort_keys=False)
  storage.write_whole(output / COPY, text.encode())


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
  description = storage.read_json(folder / SWEEP)
  is_mapping = isinstance(description, dict)
  existing = {
      **loading.read_mapping(folder / EXPERIMENT),
      'calibration': is_mapping and description.get('calibration'),
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


@final
@dataclasses.dataclass
class _Run:
  """A job of a sweep."""

  job: jobs.Job
  folder: pathlib.Path
  log: pathlib.Path
  task: Any = None

  def __str__(self) -> str:
    return f'{self.job.run}, seed {self.job.seed}'

  @property
  def user(self) -> str:
    """Message on the process that writes to the folder, or ''."""
    if self.folder.exists() and not (self.folder / storage.DONE).exists():
      try:
        with storage.locked(self.folder):
          return ''
      except errors.InUseError as error:
        return str(error)
    return ''


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
    self._engine = engine
    self._output = output
    self._say = say
    self._arguments = arguments
    self._all = [
        _Run(
            job,
            output / job.folder(),
            output / LOGS / f'{job.folder()}.log',
        )
        for job in wanted
    ]
    self._waiting = list(self._all)
    self._running: list[_Run] = []
    self._failures: list[str] = []
    self._said: set[str] = set()
    self._said_at = time.monotonic()
    self._num_finished = 0

  def run(self) -> None:
    """Runs all jobs; see `sweep`."""
    count = len(self._all)
    with tqdm.tqdm(total=count, unit='job', disable=None) as bar:
      try:
        while self._waiting or self._running:
          self._start_waiting()
          self._poll()
          bar.update(self._num_finished - bar.n)
          bar.refresh()
          self._say_progress(time.monotonic())
          if self._waiting or self._running:
            time.sleep(_POLL_SECONDS)
      finally:
        self._engine.stop([run.task for run in self._running])
    if self._failures:
      raise errors.ResultsError(
          f'{len(self._failures)} of {count} jobs failed:'
          f' {"; ".join(self._failures)}; results of the others are in'
          f' {self._output}'
      )
    self._say(f'{count} jobs finished; results are in {self._output}')

  def _say_progress(self, now: float) -> None:
    """Says the last line of a running job, every half minute, if it is new."""
    if now < self._said_at + _LINE_SECONDS:
      return
    for run in self._running:
      line = _last_line(run.log)
      if line.startswith(str(run)) and line not in self._said:
        self._said_at = now
        self._say_once(line)
        return

  def _start_waiting(self) -> None:
    for run in list(self._waiting):
      if len(self._running) == self._engine.capacity:
        return
      if user := run.user:
        # A process may survive its worker, and jobs of a cluster their sweep.
        self._say_once(f'{run}: {user}')
        continue
      self._waiting.remove(run)
      self._start(run)

  def _say_once(self, line: str) -> None:
    if line not in self._said:
      self._said.add(line)
      self._say(line)

  def _start(self, run: _Run) -> None:
    try:
      facts = storage.finished(run.folder, training.RECORDS)
    except errors.ResultsError as error:
      self._finish(run, str(error))
      return
    if facts:
      if facts[storage.FILES] is None:
        self._say_once(f'{self._output}: {storage.NO_IMPRINTS}')
      self._finish(run, '')
      return
    command = [
        sys.executable,
        '-m',
        _MODULE,
        f'--experiment={self._output / COPY}',
        f'--run={run.job.run}',
        f'--seed={run.job.seed}',
        f'--output={self._output}',
        f'--planned={run.folder.name}',
        *self._arguments,
    ]
    run.task = self._engine.start(command, run.log)
    self._running.append(run)

  def _poll(self) -> None:
    for run in list(self._running):
      problem = ''
      try:
        status = self._engine.poll(run.task)
      except errors.ResultsError as error:
        # A machine of a cluster may be lost; the other jobs continue.
        status, problem = 1, f'{error}; {_ADVICE}'
      if status is None:
        continue
      self._running.remove(run)
      if status < 0:
        problem = f'killed by signal {-status}; {_ADVICE}'
      elif not problem and (status or not (run.folder / storage.DONE).exists()):
        problem = _last_line(run.log) or f'exit status {status}'
      self._finish(run, problem)

  def _finish(self, run: _Run, problem: str) -> None:
    self._num_finished += 1
    if problem:
      self._failures.append(f'{run}: {problem}')
    self._say(
        f'[{self._num_finished}/{len(self._all)}] {run}:'
        f' {problem or f"finished, results in {run.folder}"}'
    )


def _last_line(path: pathlib.Path) -> str:
  """Returns the last line of a file, or '', without reading all of it."""
  try:
    with open(path, 'rb') as file:
      file.seek(max(0, os.fstat(file.fileno()).st_size - 4096))
      lines = file.read().decode(errors='replace').strip().splitlines()
  except OSError:
    return ''
  return lines[-1] if lines else ''

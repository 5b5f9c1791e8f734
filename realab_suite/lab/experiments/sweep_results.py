"""Reader of the results of a sweep, in its folder or published.

All files are validated: an error names the damaged line. Jobs without results
are listed as unfinished.
"""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import functools
import json
import pathlib
from typing import Annotated, Any, Final, TypeVar, final

import pydantic

from realab_suite import errors
from realab_suite import worlds
from realab_suite.config import loading
from realab_suite.config import task_names
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import stakes

_Model = TypeVar('_Model', bound=pydantic.BaseModel)

CONTENTS: Final = 'published.json'
"""File in the folder of published results; see `publishing`."""


@final
class Job(pydantic.BaseModel):
  """One seed of one run, as planned by the sweep."""

  model_config = pydantic.ConfigDict(frozen=True)

  run: str
  seed: int
  # The pattern admits only folders beside the file, even if it was edited.
  folder: Annotated[
      str, pydantic.StringConstraints(pattern=r'^[A-Za-z0-9][A-Za-z0-9_.-]*$')
  ]
  kind: str
  is_scripted: bool
  design: str
  channel: str
  baseline: str | None
  twin_of: str | None


Lines = Callable[[int, str], list[dict[str, Any]]]
"""Returns the records of a job in a file of lines, by seed and name."""


@final
class _Description(pydantic.BaseModel):
  """Contents of `sweep.json`, which `scheduler` writes."""

  experiment: str
  calibration: bool
  jobs: list[Job] = pydantic.Field(min_length=1)


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Run:
  """Results of the finished jobs of one run.

  Attributes:
    name: Name of the run.
    jobs: All planned jobs.
    lines: Reader of the other records of finished jobs. Published, equal
      training episodes between two points of the curve have one record with
      their number, and there are no training times.
    trace: Reader of the traces of finished jobs, by seed; see `traces.Tracer`.
    rows: Evaluation episodes.
    transplants: Evaluation episodes of the learner of a secure twin in the
      design of its run; empty for other runs.
    configs: Configurations of the finished jobs, by seed.
    stages: Evaluation episodes of the learner before adaptation, whose runs end
      with the name of a stage, as in `jobs`; empty without adaptation.
  """

  name: str
  jobs: tuple[Job, ...]
  lines: Lines
  trace: Callable[[int], dict[str, Any]]
  rows: tuple[results.EpisodeResult, ...]
  transplants: tuple[results.EpisodeResult, ...]
  configs: Mapping[int, Mapping[str, Any]]
  stages: tuple[results.EpisodeResult, ...] = ()

  @property
  def is_scripted(self) -> bool:
    """True if the agent is a scripted policy."""
    return self.jobs[0].is_scripted

  @property
  def twin_of(self) -> str | None:
    """Name of the run whose secure twin this is, or `None`."""
    return self.jobs[0].twin_of

  @property
  def baseline(self) -> str | None:
    """Name of the run to compare with, or `None`."""
    return self.jobs[0].baseline

  @property
  def is_done(self) -> bool:
    """True if any seed has results."""
    return bool(self.rows)

  @property
  def config(self) -> Mapping[str, Any]:
    """Configuration of the first finished seed."""
    return next(iter(self.configs.values()))

  @functools.cached_property
  def design(self) -> specs.DesignSpec:
    """Design of the run."""
    return specs.load(self.config['design'], is_confined=True)

  @functools.cached_property
  def world(self) -> worlds.World:
    """World in which the run was evaluated."""
    domain, task = task_names.split(self.config['task'])
    senses = self.config['environment_kwargs']['senses']
    return worlds.World(
        domain,
        task,
        self.config['max_steps'],
        self.config['task_kwargs'],
        senses and tuple(senses),
    )

  def evaluation_seed(self, seed: int) -> int:
    """Returns the seed of the evaluation episodes of a finished job."""
    offset: int = self.configs[seed]['evaluation']['seed_offset']
    return seed + offset

  @property
  def stake(self) -> stakes.Stakes | None:
    """Stakes of the design, or `None` if there are none, or no rows."""
    return stakes.of(self.rows[0]) if self.rows else None

  @functools.cached_property
  def curves(self) -> dict[int, list[dict[str, Any]]]:
    """Learning curve of each seed; empty for a scripted policy."""
    return self._lines_by_seed(training.CURVE)

  @functools.cached_property
  def timing(self) -> dict[int, list[dict[str, Any]]]:
    """Training times of each seed; empty for a scripted policy."""
    return self._lines_by_seed(training.TIMING)

  def training_episodes(self) -> dict[int, list[dict[str, Any]]]:
    """Returns the record of each training episode, by seed."""
    return {
        seed: [
            record
            for record in records
            for _ in range(record.get('num_episodes', 1))
        ]
        for seed, records in self._lines_by_seed(
            training.TRAINING_EPISODES
        ).items()
    }

  def _lines_by_seed(self, name: str) -> dict[int, list[dict[str, Any]]]:
    seeds = () if self.is_scripted else self.configs
    return {seed: self.lines(seed, name) for seed in seeds}

  @functools.cached_property
  def traces(self) -> dict[int, dict[str, Any]]:
    """Trace of each seed.

    Raises:
      ResultsError: If a file is damaged, belongs to another run, or is not
        published.
    """
    return {seed: self.trace(seed) for seed in self.configs}


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
  """Results of a sweep.

  Attributes:
    folder: Folder of the sweep.
    experiment: Contents of the experiment file.
    is_calibration: True if its seeds are calibration seeds, not to be reported.
    runs: All runs by name, in planned order.
    unfinished: Jobs without results.
    audits: Contents of the audits of runs, by name of the run.
    has_traces: False if the results are published, without actions.
  """

  folder: pathlib.Path
  experiment: Mapping[str, Any]
  is_calibration: bool
  runs: Mapping[str, Run]
  unfinished: tuple[Job, ...]
  audits: Mapping[str, Any]
  has_traces: bool = True

  @property
  def seeds(self) -> list[int]:
    """All planned seeds."""
    jobs = (job for run in self.runs.values() for job in run.jobs)
    return list(dict.fromkeys(job.seed for job in jobs))

  @property
  def codes(self) -> set[str]:
    """Codes of all rows; see `results.versions`."""
    return {
        row.info.versions.get(storage.CODE, 'unknown')
        for run in self.runs.values()
        for row in (*run.rows, *run.transplants, *run.stages)
    }

  def learned(self) -> list[Run]:
    """Returns the runs of learners, except twins."""
    return [
        run
        for run in self.runs.values()
        if not run.is_scripted and run.twin_of is None
    ]

  def twin(self, run: Run) -> Run | None:
    """Returns the secure twin of a run, or `None`."""
    twins = (one for one in self.runs.values() if one.twin_of == run.name)
    return next(twins, None)

  def family(self, run: Run) -> str:
    """Returns the learned run that a twin or a baseline belongs to."""
    if run.twin_of is not None:
      return run.twin_of
    if not run.is_scripted:
      return run.name
    for learned_run in self.learned():
      if run.name.startswith(f'{learned_run.name}.'):
        return learned_run.name
    return run.name


def validated(model: type[_Model], content: Any, path: pathlib.Path) -> _Model:
  """Returns the contents of a file as a model.

  Raises:
    ResultsError: If they do not fit. The message names the file and the first
      problem.
  """
  try:
    return model.model_validate(content)
  except pydantic.ValidationError as error:
    first = error.errors()[0]
    key_path = '.'.join(map(str, first['loc'])) or 'contents'
    raise errors.ResultsError(f'{path}: {key_path}: {first["msg"]}') from error


def by_run(planned: Sequence[Job]) -> dict[str, list[Job]]:
  """Returns jobs by the names of their runs, in planned order."""
  jobs_of_runs: dict[str, list[Job]] = {}
  for job in planned:
    jobs_of_runs.setdefault(job.run, []).append(job)
  return jobs_of_runs


def load(folder: pathlib.Path) -> Sweep:
  """Reads the folder of a sweep; for published results, see `result_folders`.

  Raises:
    ResultsError: If it is not one, or a file in it is damaged. The message
      names the file and, if possible, the line.
  """
  if not (folder / scheduler.SWEEP).is_file():
    raise errors.ResultsError(
        f'{folder}: not the folder of a sweep: it has no {scheduler.SWEEP};'
        ' must be an --output folder of realab_suite.launchers.sweep, or, if it'
        ' is to be read only, of realab_suite.launchers.publish'
    )
  path = folder / scheduler.SWEEP
  description = validated(_Description, storage.read_json(path), path)
  planned = by_run(description.jobs)
  unfinished = tuple(
      job
      for of_run in planned.values()
      for job in of_run
      if not (folder / job.folder / storage.DONE).exists()
  )
  return Sweep(
      folder,
      loading.read_mapping(folder / scheduler.EXPERIMENT),
      description.calibration,
      {name: _run(folder, name, of_run) for name, of_run in planned.items()},
      unfinished,
      _audits(folder, planned),
  )


def _audits(
    folder: pathlib.Path, runs: Mapping[str, Sequence[Job]]
) -> dict[str, Any]:
  """Reads the audits beside a sweep.

  Raises:
    ResultsError: If a file is not that of a run, or is no JSON.
  """
  audits = {}
  names = sorted(f'{name}.json' for name in runs)
  for path in sorted((folder / scheduler.AUDITS).glob('*')):
    if path.name not in names:
      raise errors.ResultsError(
          f'{path}: not the audit of a run; must be one of {names}'
      )
    audits[path.stem] = storage.read_json(path)
  return audits


def read_lines(path: pathlib.Path) -> list[dict[str, Any]]:
  """Reads a file with a JSON mapping in each line.

  Raises:
    ResultsError: If the file cannot be read or a line is no JSON mapping. The
      message names the line.
  """
  with storage.explained(path):
    text = path.read_bytes()
  records = []
  for number, line in enumerate(text.splitlines(), start=1):
    try:
      records.append(dict(json.loads(line)))
    except (TypeError, ValueError, RecursionError) as error:
      raise errors.ResultsError(
          f'{path}:{number}: not JSON of a mapping: {error}'
      ) from error
  return records


def _run(folder: pathlib.Path, name: str, planned: Sequence[Job]) -> Run:
  folders, configs = {}, {}
  rows: list[results.EpisodeResult] = []
  transplants: list[results.EpisodeResult] = []
  stages: list[results.EpisodeResult] = []
  for job in planned:
    path = folder / job.folder
    if path.is_symlink():
      raise errors.ResultsError(
          f'{path}: must be a folder of the sweep, not a symbolic link'
      )
    if not (path / storage.DONE).exists():
      continue
    # Rows first: their errors name the damaged line.
    rows += _rows(path / training.EPISODES, job.run)
    if job.twin_of is not None:
      run = f'{job.twin_of}.{jobs.TRANSPLANT}'
      transplants += _rows(path / training.TRANSPLANT, run)
    if (path / training.STAGES).exists():
      names = (f'{job.run}.{stage}' for stage in jobs.STAGES)
      stages += _rows(path / training.STAGES, *names)
    folders[job.seed] = path
    configs[job.seed] = jobs.read_config(path)
  check_stakes(folder, name, rows)
  check_stakes(folder, name, transplants)
  return Run(
      name,
      tuple(planned),
      lambda seed, name: read_lines(folders[seed] / name),
      lambda seed: _trace(folders[seed], configs[seed]),
      tuple(rows),
      tuple(transplants),
      configs,
      tuple(stages),
  )


def _trace(path: pathlib.Path, config: Mapping[str, Any]) -> dict[str, Any]:
  header = training.header(jobs.digest_of(config), training.TRACE)
  trace: dict[str, Any] = storage.read_archive(path / training.TRACE, header)
  return trace


def _rows(path: pathlib.Path, *runs: str) -> list[results.EpisodeResult]:
  rows = list(results.read_rows(path))
  for number, row in enumerate(rows, start=1):
    if row.info.run not in runs:
      raise errors.ResultsError(
          f'{path}:{number}: a row of run {row.info.run!r}; must be'
          f' {" or ".join(map(repr, runs))}'
      )
  if not rows:
    raise errors.ResultsError(f'{path}: no rows; at least one is needed')
  return rows


def check_stakes(
    folder: pathlib.Path, name: str, rows: Sequence[results.EpisodeResult]
) -> None:
  """Checks that all episodes of a run have been measured against one stake.

  Raises:
    ResultsError: If they have not, for example because a sweep was continued
      after the dynamics had changed.
  """
  keys = sorted(
      {row.extras.get('stake', {}).get('key', 'none') for row in rows}
  )
  if len(keys) > 1:
    raise errors.ResultsError(
        f'{folder}: the rows of run {name!r} have stakes with the keys'
        f' {", ".join(keys)}, not with one; run it again in another'
        ' folder'
    )

"""What a sweep has left in its folder, read for whoever sums it up.

Nothing is taken on trust: a line that is none is an error that names it, and a
run that is not over is said to be so, not summed up.
"""

from collections.abc import Mapping, Sequence
import dataclasses
import functools
import json
import pathlib
from typing import Annotated, Any, final

import pydantic

from realab_suite import errors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import results
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.experiments import training
from realab_suite.feedback import specs

_CURVE_KEYS = (
    'step', 'num_episodes', 'num_invalid', 'true_return', 'observed_return',
    'registers',
)  # fmt: skip
_EPISODE_KEYS = ('num_steps', 'is_valid', 'registers')
_TIMING_KEYS = ('step', 'seconds')


@final
class Job(pydantic.BaseModel):
  """One seed of one run, as the sweep has planned it."""

  model_config = pydantic.ConfigDict(frozen=True)

  run: str
  seed: int
  # The name of a folder beside this file, whoever has written it.
  folder: Annotated[
      str, pydantic.StringConstraints(pattern=r'^[A-Za-z0-9][A-Za-z0-9_.-]*$')
  ]
  kind: str
  is_scripted: bool
  design: str
  channel: str
  baseline: str | None
  twin_of: str | None


@final
class _Description(pydantic.BaseModel):
  """What `sweeping` writes of a sweep."""

  experiment: str
  calibration: bool
  jobs: list[Job] = pydantic.Field(min_length=1)


@final
@dataclasses.dataclass(frozen=True)
class Unfinished:
  """A job without results.

  Attributes:
    job: The job.
    steps: How many control steps of training it is known to have had.
    has_begun: Whether it has a folder.
  """

  job: Job
  steps: int
  has_begun: bool


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Run:
  """The jobs of one run that are over.

  Attributes:
    name: Of the run.
    jobs: All that were planned.
    folders: Of those that are over, by seed.
    rows: The episodes that it was judged by.
    configs: Of each seed that is over.
  """

  name: str
  jobs: tuple[Job, ...]
  folders: Mapping[int, pathlib.Path]
  rows: tuple[results.EpisodeRow, ...]
  configs: Mapping[int, Mapping[str, Any]]

  @property
  def is_scripted(self) -> bool:
    """Whether it is a scripted policy."""
    return self.jobs[0].is_scripted

  @property
  def twin_of(self) -> str | None:
    """The run that this is the secure twin of."""
    return self.jobs[0].twin_of

  @property
  def baseline(self) -> str | None:
    """The run to compare with."""
    return self.jobs[0].baseline

  @property
  def is_done(self) -> bool:
    """Whether there is a result of any seed."""
    return bool(self.rows)

  @property
  def config(self) -> Mapping[str, Any]:
    """Of the first seed that is over."""
    return next(iter(self.configs.values()))

  @functools.cached_property
  def design(self) -> specs.DesignSpec:
    """The design that the run was made with."""
    return specs.load(self.config['design'], is_confined=True)

  @functools.cached_property
  def curves(self) -> dict[int, list[dict[str, Any]]]:
    """The learning curve of each seed; none of a scripted policy."""
    return self._lines(training.CURVE, _CURVE_KEYS)

  @functools.cached_property
  def timing(self) -> dict[int, list[dict[str, Any]]]:
    """How long each seed took; none of a scripted policy."""
    return self._lines(training.TIMING, _TIMING_KEYS)

  def training_episodes(self) -> dict[int, list[dict[str, Any]]]:
    """Returns what became of each episode of training, by seed."""
    return self._lines(training.TRAINING_EPISODES, _EPISODE_KEYS)

  @functools.cached_property
  def traces(self) -> dict[int, dict[str, Any]]:
    """What `traces.Tracer` has kept of each seed.

    Raises:
      ResultsError: If a file is damaged, or of another run.
    """
    return {
        seed: storage.read_archive(
            path / training.TRACE,
            training.header(jobs.digest_of(self.configs[seed]), training.TRACE),
        )
        for seed, path in self.folders.items()
    }

  def _lines(
      self, name: str, keys: Sequence[str]
  ) -> dict[int, list[dict[str, Any]]]:
    if self.is_scripted:
      return {}
    return {
        seed: read_lines(path / name, keys)
        for seed, path in self.folders.items()
    }


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
  """A folder of a sweep.

  Attributes:
    folder: The folder.
    experiment: What was to be done, as the file has it.
    is_calibration: Whether its seeds are none that are reported.
    runs: All runs, by name, in the order in which they were planned.
    unfinished: The jobs without results.
  """

  folder: pathlib.Path
  experiment: Mapping[str, Any]
  is_calibration: bool
  runs: Mapping[str, Run]
  unfinished: tuple[Unfinished, ...]

  @property
  def seeds(self) -> list[int]:
    """All seeds that were planned."""
    jobs = (job for run in self.runs.values() for job in run.jobs)
    return list(dict.fromkeys(job.seed for job in jobs))

  @functools.cached_property
  def margin(self) -> float:
    """The smallest mean corruption that matters in any of its runs, metres."""
    return comparison.margin_of(
        register.scale
        for run in self.runs.values()
        if run.is_done
        for register in run.design.registers.values()
    )

  def learned(self) -> list[Run]:
    """Returns the runs of learners that are no twins."""
    return [
        run
        for run in self.runs.values()
        if not run.is_scripted and run.twin_of is None
    ]

  def twin(self, run: Run) -> Run | None:
    """Returns the secure twin of a run."""
    twins = (one for one in self.runs.values() if one.twin_of == run.name)
    return next(twins, None)

  def family(self, run: Run) -> str:
    """Returns the learned run that a twin or a baseline belongs to."""
    if run.twin_of is not None:
      return run.twin_of
    if not run.is_scripted:
      return run.name
    for one in self.learned():
      if run.name.startswith(f'{one.name}.'):
        return one.name
    return run.name


def load(folder: pathlib.Path) -> Sweep:
  """Reads the folder of a sweep.

  Raises:
    ResultsError: If it is none, or a file in it is not what it was written as;
      the message names the file and, where there is one, the line.
  """
  if not (folder / scheduler.SWEEP).is_file():
    raise errors.ResultsError(
        f'{folder} is no folder of a sweep: it has no {scheduler.SWEEP};'
        ' allowed is what --output of realab_suite.launchers.sweep named'
    )
  path = folder / scheduler.SWEEP
  try:
    content = scheduler.read_description(folder)
    description = _Description.model_validate(content)
  except pydantic.ValidationError as error:
    first = error.errors()[0]
    key_path = '.'.join(str(part) for part in first['loc'])
    raise errors.ResultsError(
        f'{path}: {key_path or "contents"}: {first["msg"]}'
    ) from error
  unfinished: list[Unfinished] = []
  planned: dict[str, list[Job]] = {}
  for job in description.jobs:
    planned.setdefault(job.run, []).append(job)
  runs = {
      name: _run(folder, name, of, unfinished) for name, of in planned.items()
  }
  return Sweep(
      folder,
      scheduler.read_experiment(folder, content),
      description.calibration,
      runs,
      tuple(unfinished),
  )


def read_lines(path: pathlib.Path, keys: Sequence[str]) -> list[dict[str, Any]]:
  """Reads a file of lines of JSON, each a mapping that has these keys.

  Raises:
    ResultsError: If it cannot be read, or a line is none; it names the line.
  """
  with storage.explained(path):
    text = path.read_bytes()
  records = []
  for number, line in enumerate(text.splitlines(), start=1):
    try:
      record = json.loads(line)
    except (ValueError, RecursionError) as error:
      raise errors.ResultsError(
          f'{path}:{number}: not JSON: {error}'
      ) from error
    lacking = [
        key for key in keys if not isinstance(record, dict) or key not in record
    ]
    if lacking:
      raise errors.ResultsError(f'{path}:{number}: has no {lacking[0]!r}')
    records.append(record)
  return records


def _run(
    folder: pathlib.Path,
    name: str,
    planned: Sequence[Job],
    unfinished: list[Unfinished],
) -> Run:
  folders, rows, configs = {}, [], {}
  for job in planned:
    path = folder / job.folder
    if path.is_symlink():
      raise errors.ResultsError(
          f'{path}: a link; allowed are folders within that of the sweep'
      )
    if not (path / storage.DONE).exists():
      unfinished.append(_unfinished(job, path))
      continue
    # Lines first, because they say what is wrong and where.
    rows += _rows(path / training.EPISODES, job)
    jobs.is_done(path)
    folders[job.seed] = path
    configs[job.seed] = jobs.read_config(path)
  return Run(name, tuple(planned), folders, tuple(rows), configs)


def _rows(path: pathlib.Path, job: Job) -> list[results.EpisodeRow]:
  rows = list(results.read_rows(path))
  for number, row in enumerate(rows, start=1):
    if row.info.run != job.run:
      raise errors.ResultsError(
          f'{path}:{number}: a row of run {row.info.run!r}; allowed here is'
          f' {job.run!r}'
      )
  if not rows:
    raise errors.ResultsError(f'{path}: no rows; allowed is one at least')
  return rows


def _unfinished(job: Job, path: pathlib.Path) -> Unfinished:
  """Returns how far a job has come, as far as whole lines tell."""
  steps = 0
  curve = path / training.CURVE
  if curve.exists():
    with storage.explained(curve):
      lines = curve.read_bytes().splitlines()
    for line in lines[-2:]:  # Of a run under way, the last may be half there.
      try:
        steps = int(json.loads(line)['step'])
      except (ValueError, KeyError, TypeError):
        continue
  return Unfinished(job, steps, path.exists())

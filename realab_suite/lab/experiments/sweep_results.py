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

from absl import logging
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
PARTS: Final = {
    'rows': training.EPISODES,
    'transplants': training.TRANSPLANT,
    'stages': training.STAGES,
}
"""Files of the rows of a job, by the attribute of `Run` that has them."""
# Keys of records that reports need.
_KEYS = {
    training.CURVE: (
        'step', 'num_episodes', 'num_invalid', 'true_return', 'gain',
    ),
    training.TRAINING_EPISODES: (
        'step', 'objective', 'is_ended_by_tampering',
    ),
}  # fmt: skip
Parts = dict[str, list[results.EpisodeResult]]


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


def _distinct(planned: list[Job]) -> list[Job]:
  """Returns jobs of which no two are the same: both would count."""
  folders = {job.folder for job in planned}
  if (
      not len(folders)
      == len({(x.run, x.seed) for x in planned})
      == len(planned)
  ):
    raise ValueError('two jobs have the same folder, or the same run and seed')
  return planned


Jobs = Annotated[
    list[Job], pydantic.Field(min_length=1), pydantic.AfterValidator(_distinct)
]
"""All jobs of a sweep."""
Lines = Callable[[int, str], list[dict[str, Any]]]
"""Returns the records of a job in a file of lines, by seed and name."""


@final
class _Description(pydantic.BaseModel):
  """Contents of `sweep.json`, which `scheduler` writes."""

  experiment: str
  calibration: bool
  jobs: Jobs


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
    return specs.load(self.config['design'])

  @functools.cached_property
  def world(self) -> worlds.World:
    """World in which the run was evaluated."""
    return _world(self.config)

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
    lines = {seed: self.lines(seed, name) for seed in seeds}
    for seed, record in (
        (s, x) for s, of_seed in lines.items() for x in of_seed
    ):
      if missing := [key for key in _KEYS.get(name, ()) if key not in record]:
        raise errors.ResultsError(
            f'{self.name}, seed {seed}: a record of {name} has {list(record)};'
            f' must have {missing} as well'
        )
    return lines

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
    has_imprints: False if a former version has recorded no digests.

  Raises:
    ResultsError: If the experiment lacks what reports need.
  """

  folder: pathlib.Path
  experiment: Mapping[str, Any]
  is_calibration: bool
  runs: Mapping[str, Run]
  unfinished: tuple[Job, ...]
  audits: Mapping[str, Any]
  has_traces: bool = True
  has_imprints: bool = True

  def __post_init__(self) -> None:
    if not self.has_imprints:
      logging.warning('%s: %s', self.folder, storage.NO_IMPRINTS)
    with storage.fitting(self.folder / scheduler.EXPERIMENT):
      for group, key in ('training', 'steps'), ('evaluation', 'episodes'):
        f'{self.experiment[group][key]:,}'
      for run in self.learned():
        task_names.split(
            self.experiment['runs'][run.name].get('task')
            or self.experiment['task']
        )

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


def _world(config: Mapping[str, Any]) -> worlds.World:
  """Returns the world of a configuration."""
  senses = config['environment_kwargs']['senses']
  return worlds.World(
      *task_names.split(config['task']),
      int(config['max_steps']),
      dict(config['task_kwargs']),
      senses and tuple(senses),
  )


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
  runs = {name: _run(folder, name, of_run) for name, of_run in planned.items()}
  # Later than the rows, whose errors name the line.
  facts = [
      storage.finished(folder / job.folder, training.RECORDS)
      for job in description.jobs
  ]
  return Sweep(
      folder,
      loading.read_mapping(folder / scheduler.EXPERIMENT),
      description.calibration,
      runs,
      unfinished,
      _audits(folder, planned),
      has_imprints=all(x[storage.FILES] is not None for x in facts if x),
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
  parts: Parts = {part: [] for part in PARTS}
  for job in planned:
    path = folder / job.folder
    if path.is_symlink():
      raise errors.ResultsError(
          f'{path}: must be a folder of the sweep, not a symbolic link'
      )
    if not (path / storage.DONE).exists():
      continue
    folders[job.seed] = path
    configs[job.seed] = config = jobs.read_config(path)
    files = {part: path / name for part, name in PARTS.items()}
    of_job = {
        part: list(results.read_rows(file))
        for part, file in files.items()
        if part == 'rows' or file.exists()
    }
    for part, rows in of_job.items():
      parts[part] += rows
    check_job(path / storage.CONFIG, files, job, config, of_job)
  for part in ('rows', 'transplants'):
    check_stakes(folder, name, parts[part])
  return Run(
      name=name,
      jobs=tuple(planned),
      lines=lambda seed, name: read_lines(folders[seed] / name),
      trace=lambda seed: _trace(folders[seed], configs[seed]),
      configs=configs,
      **{part: tuple(rows) for part, rows in parts.items()},
  )


def _trace(path: pathlib.Path, config: Mapping[str, Any]) -> dict[str, Any]:
  header = training.header(jobs.digest_of(config), training.TRACE)
  trace: dict[str, Any] = storage.read_archive(path / training.TRACE, header)
  return trace


def check_job(
    path: pathlib.Path,
    files: Mapping[str, pathlib.Path],
    job: Job,
    config: Mapping[str, Any],
    parts: Mapping[str, Sequence[results.EpisodeResult]],
) -> None:
  """Checks that a job has its own configuration and all of its own rows.

  Args:
    path: File of the configuration.
    files: Files of the rows, by part.
    job: The job.
    config: The configuration.
    parts: The rows, by part.

  Raises:
    ResultsError: If not. The message names the first difference.
  """
  with storage.fitting(path):
    design, policy = config['design'], config['policy']
    there = {
        **{key: config[key] for key in ('run', 'seed', 'baseline', 'twin_of')},
        **{'design': design['name'], 'channel': design['channel']},
        'kind': policy or design['learner']['kind'],
        'is_scripted': policy is not None,
    }
    _compare(f'{path}: {job.folder}', there, job.model_dump(exclude={'folder'}))
    num_episodes, offset = (
        int(config['evaluation'][key]) for key in ('episodes', 'seed_offset')
    )
    runs: dict[str, tuple[str, ...]] = {'rows': (job.run,)}
    if job.twin_of is not None:
      runs['transplants'] = (f'{job.twin_of}.{jobs.TRANSPLANT}',)
    if not job.is_scripted and config['training'].get('tasks'):
      runs['stages'] = tuple(f'{job.run}.{stage}' for stage in jobs.STAGES)
    designs = {'transplants': config['embedded']}
    of_world = {'task': config['task'], 'max_steps': config['max_steps']}
    _world(config)
  for part, names in {**dict.fromkeys(parts, ()), **runs}.items():
    rows = parts.get(part, ())
    for number, row in enumerate(rows, start=1):
      place, info = f'{files[part]}:{number}', row.info
      if info.run not in names:
        raise errors.ResultsError(
            f'{place}: a row of run {info.run!r}; must be'
            f' {" or ".join(map(repr, names)) or "none"}'
        )
      with storage.fitting(path):
        named = designs.get(part, design)
        expected = {
            'seed': job.seed + offset, 'policy': job.kind,
            'design': named['name'], 'channel': named['channel'], **of_world,
        }  # fmt: skip
      there = {key: getattr(info, key) for key in expected if key != 'seed'}
      there |= {'seed': row.seed, 'task': f'{info.domain}.{info.task}'}
      if part == 'stages':  # Training has other tasks.
        del there['task'], expected['task']
      _compare(place, there, expected)
    keys = sorted((row.info.run, row.world, row.episode) for row in rows)
    planned = [(name, i, 0) for name in names for i in range(num_episodes)]
    if keys != sorted(planned):
      raise errors.ResultsError(
          f'{files[part]}: {job.folder} has {len(rows)} rows of'
          f' {len(set(keys))} episodes; must have one of each of the'
          f' {len(planned)} episodes of {" and ".join(names) or "no run"}'
      )


def _compare(place: str, there: Any, here: Any) -> None:
  """Refuses what is found there if it is not as planned here."""
  if there != here:
    raise errors.ResultsError(
        f'{place}: is of another job: {storage.difference(there, here)}'
    )


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

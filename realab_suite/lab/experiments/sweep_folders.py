"""The study of a sweep, read from its folder.

All files are validated: an error names the damaged line. Jobs without results
are listed as unfinished.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
import json
import pathlib
from typing import Annotated, Any, Final, TypeVar, final

from absl import logging
import pydantic

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import task_names
from realab_suite.evaluation import results
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import study

_Model = TypeVar('_Model', bound=pydantic.BaseModel)

CONTENTS: Final = 'published.json'
"""File in the folder of published results; see `publishing`."""
PARTS: Final = {
    'rows': training.EPISODES,
    'transplants': training.TRANSPLANT,
    'stages': training.STAGES,
}
"""Files of the rows of a job, by what they are: those of a run, those of the
twin's learner in the design of its run, and those before adaptation."""
_FILES = {
    study.CURVE: training.CURVE,
    study.EPISODES: training.TRAINING_EPISODES,
    study.TIMING: training.TIMING,
}
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


@final
class _Description(pydantic.BaseModel):
  """Contents of `sweep.json`, which `scheduler` writes."""

  experiment: str
  calibration: bool
  jobs: Jobs


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


def load(folder: pathlib.Path) -> study.Study:
  """Reads the folder of a sweep; for other folders, see `studies`.

  Raises:
    ResultsError: If it is not one, or a file in it is damaged. The message
      names the file and, if possible, the line.
  """
  description = _described(folder)
  planned = by_run(description.jobs)
  runs = [run for of_run in planned.values() for run in _runs(folder, of_run)]
  # Later than the rows, whose errors name the line.
  facts = [
      storage.finished(folder / job.folder, training.RECORDS)
      for job in description.jobs
  ]
  return made(
      folder,
      description.jobs,
      runs,
      experiment=loading.read_mapping(folder / scheduler.EXPERIMENT),
      is_calibration=description.calibration,
      audits=_audits(folder, planned),
      has_imprints=all(x[storage.FILES] is not None for x in facts if x),
  )


def planned_in(folder: pathlib.Path) -> list[Job]:
  """Returns all jobs of the sweep in a folder; see `load`."""
  return _described(folder).jobs


def _described(folder: pathlib.Path) -> _Description:
  if not (folder / scheduler.SWEEP).is_file():
    raise errors.ResultsError(
        f'{folder}: not the folder of a sweep: it has no {scheduler.SWEEP};'
        ' must be an --output folder of realab_suite.launchers.sweep, or, if it'
        ' is to be read only, of realab_suite.launchers.publish'
    )
  path = folder / scheduler.SWEEP
  return validated(_Description, storage.read_json(path), path)


def made(
    folder: pathlib.Path,
    planned: Sequence[Job],
    runs: Iterable[study.Run],
    **others: Any,
) -> study.Study:
  """Returns the study of a sweep, from its folder or published.

  Args:
    folder: The folder.
    planned: All jobs.
    runs: The runs.
    **others: Values of the other attributes.

  Raises:
    ResultsError: If the experiment lacks what reports need.
  """
  controls_last = sorted(runs, key=lambda run: run.role is study.Role.CONTROL)
  by_name = {run.name: run for run in controls_last}
  sweep = study.Study(
      by_name,
      folder,
      unfinished=[
          (job.run, job.seed)
          for of_run in by_run(planned).values()
          for job in of_run
          if job.seed not in by_name[job.run].configs
      ],
      **others,
  )
  if not sweep.has_imprints:
    logging.warning('%s: %s', folder, storage.NO_IMPRINTS)
  with storage.fitting(folder / scheduler.EXPERIMENT):
    for group, key in ('training', 'steps'), ('evaluation', 'episodes'):
      f'{sweep.experiment[group][key]:,}'
    for run in sweep.agents():
      task_names.split(
          sweep.experiment['runs'][run.name].get('task')
          or sweep.experiment['task']
      )
  return sweep


def runs_of(
    folder: pathlib.Path,
    planned: Sequence[Job],
    finished: Iterable[
        tuple[
            Job,
            pathlib.Path,
            Mapping[str, Any],
            Mapping[str, pathlib.Path],
            Parts,
        ]
    ],
    **readers: Any,
) -> Iterator[study.Run]:
  """Yields a run with its rows, and the control that a twin is as well.

  Args:
    folder: Folder of the sweep, for messages.
    planned: Jobs of the run.
    finished: The finished ones, with the file of the configuration, the
      configuration, and the files of the rows and the rows by part.
    **readers: `records` and `trace` of `study.Run`.

  Raises:
    ResultsError: If something is of another job, or rows of other stakes.
  """
  configs: dict[int, Mapping[str, Any]] = {}
  parts: Parts = {part: [] for part in PARTS}
  for job, path, config, files, of_job in finished:
    _check_job(path, files, job, config, of_job)
    configs[job.seed] = config
    for part, rows in of_job.items():
      parts[part] += rows
  for part in ('rows', 'transplants'):
    _check_stakes(folder, planned[0].run, parts[part])
  job = planned[0]
  role = study.Role.BASELINE if job.is_scripted else study.Role.AGENT
  family = job.twin_of or job.run.partition('.')[0]
  yield study.Run(
      job.run,
      role if job.twin_of is None else study.Role.TWIN,
      family,
      job.kind,
      job.design,
      tuple(parts['rows']),
      configs,
      job.baseline,
      [one.seed for one in planned],
      tuple(parts['stages']),
      **readers,
  )
  if parts['transplants']:
    yield study.Run(
        f'{family}.{hacking.TRANSPLANT}',
        study.Role.CONTROL,
        family,
        job.kind,
        job.design,
        tuple(parts['transplants']),
        {seed: {**x, 'design': x['embedded']} for seed, x in configs.items()},
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


def _runs(folder: pathlib.Path, planned: Sequence[Job]) -> Iterator[study.Run]:
  folders = {job.seed: folder / job.folder for job in planned}

  def finished() -> Iterator[Any]:
    for job in planned:
      path = folders[job.seed]
      if path.is_symlink():
        raise errors.ResultsError(
            f'{path}: must be a folder of the sweep, not a symbolic link'
        )
      if not (path / storage.DONE).exists():
        continue
      config = jobs.read_config(path)
      files = {part: path / name for part, name in PARTS.items()}
      of_job = {
          part: list(results.read_rows(file))
          for part, file in files.items()
          if part == 'rows' or file.exists()
      }
      yield job, path / storage.CONFIG, config, files, of_job

  def trace(seed: int) -> dict[str, Any]:
    path = folders[seed]
    digest = jobs.digest_of(jobs.read_config(path))
    header = training.header(digest, training.TRACE)
    read: dict[str, Any] = storage.read_archive(path / training.TRACE, header)
    return read

  return runs_of(
      folder,
      planned,
      finished(),
      records=lambda seed, kind: read_lines(folders[seed] / _FILES[kind]),
      trace=trace,
  )


def _check_job(
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
      runs['transplants'] = (f'{job.twin_of}.{hacking.TRANSPLANT}',)
    if not job.is_scripted and config['training'].get('tasks'):
      runs['stages'] = tuple(f'{job.run}.{stage}' for stage in jobs.STAGES)
    designs = {'transplants': config['embedded']}
    of_world = {'task': config['task'], 'max_steps': config['max_steps']}
    premises.world_of(config)
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


def _check_stakes(
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

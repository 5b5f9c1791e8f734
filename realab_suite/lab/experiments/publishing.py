"""Published results of a sweep: few small files, for everybody to check.

The folder has the evaluation episodes, the learning curves and the gains of
training episodes as tables, and one JSON file with the experiment, the jobs,
their configurations and the audits. Reports and scorecards read it like the
folder of a sweep. Actions are left out, so films and paths need the runs again.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import functools
import json
import pathlib
from typing import Annotated, Any, Final, Literal, Self, final

import pydantic

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.evaluation import results
from realab_suite.lab.experiments import curves
from realab_suite.lab.experiments import published_files
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_folders
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import study

_SCHEMA: Final = 1
# Columns of all tables, and of that of the rows: the folder of the job, and the
# attribute of a run that contains the row.
_JOB = 'job'
_PART = 'part'

_Index = Annotated[int, pydantic.Field(ge=0)]


@final
class _Done(pydantic.BaseModel):
  """A finished job: its configuration and machines, by their indices."""

  config: _Index
  machines: _Index


@final
class _Published(pydantic.BaseModel):
  """Contents of the JSON file.

  Attributes:
    schema_version: Version of this format; `schema` in the file.
    experiment: Contents of the experiment file.
    calibration: True if the seeds are calibration seeds.
    jobs: All planned jobs.
    done: The finished jobs, by the names of their folders.
    configs: Configurations of jobs without their seeds.
    machines: Machines of jobs, with the steps of training that they began with.
    audits: Audits of runs, by name of the run.
    collected: Premises of judgements, by their keys, `premises` in the file;
      empty in a folder of a former version.
    files: Imprints of the tables; `None` in a folder of a former version.
    digest: Digest of everything else; `None` there.
  """

  schema_version: Literal[1] = pydantic.Field(_SCHEMA, alias='schema')
  experiment: dict[str, Any]
  calibration: bool
  jobs: sweep_folders.Jobs
  done: dict[str, _Done] = pydantic.Field(min_length=1)
  configs: list[dict[str, Any]]
  machines: list[list[dict[str, Any]]]
  audits: dict[str, Any]
  collected: dict[str, premises.Premises] = pydantic.Field({}, alias='premises')
  files: dict[str, Any] | None = None
  digest: str | None = None

  @pydantic.model_validator(mode='after')
  def _check_indices(self) -> Self:
    if others := self.done.keys() - {job.folder for job in self.jobs}:
      raise ValueError(f'done: {min(others)}: none of the jobs')
    for name, done in self.done.items():
      if done.config >= len(self.configs) or done.machines >= len(
          self.machines
      ):
        raise ValueError(f'done: {name}: the index of no entry')
    return self


def publish(folder: pathlib.Path, output: pathlib.Path) -> tuple[int, int]:
  """Writes the results of a sweep into a new folder.

  The same results give the same bytes.

  Args:
    folder: Folder of the sweep, which may still be running.
    output: New or empty folder for the files.

  Returns:
    The numbers of published and of unfinished jobs.

  Raises:
    ResultsError: If no job has finished, the results are published ones, a file
      of the sweep is damaged, or the output is not empty or cannot be written.
  """
  storage.check_access(folder, is_written=False)
  sweep = sweep_folders.load(folder)
  planned = sweep_folders.planned_in(folder)
  runs = [x for x in sweep.runs.values() if x.role is not study.Role.CONTROL]
  if not any(run.is_done for run in runs):
    raise errors.ResultsError(f'{folder}: no job has finished yet')
  rows: list[dict[str, Any]] = []
  points: list[dict[str, Any]] = []
  episodes: list[dict[str, Any]] = []
  configs: list[dict[str, Any]] = []
  machines: list[list[dict[str, Any]]] = []
  done = {}
  for run in runs:
    folders = {job.seed: job.folder for job in planned if job.run == run.name}
    rows += _rows_of(sweep, run, folders)
    for seed, config in run.configs.items():
      path = folder / folders[seed] / storage.DONE
      facts = storage.read_json(path)
      done[folders[seed]] = {
          'config': _index(configs, {**config, 'seed': None}),
          'machines': _index(machines, facts.get('machines', [])),
      }
    for seed, curve in run.curves.items():
      of_job = {_JOB: folders[seed]}
      points += ({**of_job, **point} for point in curve)
      gains = curves.condensed(
          sweep_folders.read_lines(
              folder / folders[seed] / training.TRAINING_EPISODES
          ),
          curve,
      )
      episodes += ({**of_job, **gain} for gain in gains)
  storage.new_folder(str(output))
  tables = dict(
      zip(published_files.TABLES, (rows, points, episodes), strict=True)
  )
  for name, records in tables.items():
    published_files.write_table(output / name, records)
  content = {
      'schema': _SCHEMA,
      'experiment': sweep.experiment,
      'calibration': sweep.is_calibration,
      'jobs': [job.model_dump() for job in _by_run(planned)],
      'done': done,
      'configs': configs,
      'machines': machines,
      'audits': sweep.audits,
      'premises': _premises(sweep),
  }
  content[storage.FILES] = {
      name: storage.imprint(output / name, len(records))
      for name, records in tables.items()
  }
  content['digest'] = validation.digest_of(content)
  text = json.dumps(content, separators=(',', ':')) + '\n'
  storage.write_whole(output / sweep_folders.CONTENTS, text.encode())
  return len(done), len(sweep.unfinished)


def load(folder: pathlib.Path) -> study.Study:
  """Reads published results; see `studies.read`.

  Raises:
    ResultsError: If a file is missing or damaged. The message names it.
  """
  path = folder / sweep_folders.CONTENTS
  content = storage.read_json(path)
  published = sweep_folders.validated(_Published, content, path)
  tables = {
      name: _by_job(folder / name, published) for name in published_files.TABLES
  }
  rows, points, gains = tables.values()
  runs: list[study.Run] = []
  files = dict.fromkeys(sweep_folders.PARTS, folder / published_files.ROWS)

  def finished(of_run: Sequence[sweep_folders.Job]) -> Iterator[Any]:
    for job in of_run:
      if (done := published.done.get(job.folder)) is None:
        continue
      config = {**published.configs[done.config], 'seed': job.seed}
      of_job: sweep_folders.Parts = {part: [] for part in files}
      for leaves in rows.get(job.folder, ()):
        if leaves.get(_PART) not in of_job:
          raise errors.ResultsError(
              f'{folder / published_files.ROWS}: {_PART} is'
              f' {leaves.get(_PART)!r}; must be one of {list(of_job)}'
          )
        of_job[leaves[_PART]].append(_row(folder, leaves))
      yield job, path, config, files, of_job

  for of_run in sweep_folders.by_run(published.jobs).values():
    runs += sweep_folders.runs_of(
        folder,
        of_run,
        finished(of_run),
        records=_reader(
            {job.seed: points.get(job.folder, []) for job in of_run},
            {job.seed: gains.get(job.folder, []) for job in of_run},
        ),
        trace=functools.partial(_no_trace, folder),
    )
  return sweep_folders.made(
      folder,
      published.jobs,
      runs,
      experiment=published.experiment,
      is_calibration=published.calibration,
      audits=published.audits,
      collected=dict(published.collected),
      has_traces=False,
      has_imprints=_is_as_published(path, content, tables),
  )


def _premises(sweep: study.Study) -> dict[str, Any]:
  """Returns the premises of judgements on the runs of a sweep."""
  for run in sweep.runs.values():
    if run.is_done and run.role in (study.Role.AGENT, study.Role.BASELINE):
      sweep.premises_of(run)
  return {
      key: one.model_dump(mode='json') for key, one in sweep.collected.items()
  }


def _by_run(planned: Sequence[sweep_folders.Job]) -> list[sweep_folders.Job]:
  return [job for of in sweep_folders.by_run(planned).values() for job in of]


def _is_as_published(
    path: pathlib.Path,
    content: dict[str, Any],
    tables: Mapping[str, Mapping[str, Sequence[Any]]],
) -> bool:
  """Checks the imprints of a folder; returns False if there are none.

  Args:
    path: The JSON file.
    content: Its contents.
    tables: Rows of the tables by job.

  Raises:
    ResultsError: If a file has changed since it was published.
  """
  digest = content.pop('digest', None)
  if digest is None is content.get(storage.FILES):
    return False
  found = validation.digest_of(content)
  storage.check_imprint(path, f'digest {digest}', f'digest {found}')
  for name, by_job in tables.items():
    table, written = path.with_name(name), content[storage.FILES].get(name)
    imprint = storage.imprint(table, sum(map(len, by_job.values())))
    storage.check_imprint(table, written, imprint)
  return True


def _reader(
    points: Mapping[int, Sequence[Mapping[str, Any]]],
    gains: Mapping[int, Sequence[Mapping[str, Any]]],
) -> Callable[[int, str], list[dict[str, Any]]]:
  """Returns the reader of the records of a run; see `study.Run`."""

  def read(seed: int, kind: str) -> list[dict[str, Any]]:
    if kind == study.CURVE:
      # Who learns offline has no episodes: these columns have no other cells.
      empty = curves.point(0, [], {})
      return [{**empty, **point} for point in _records(points[seed])]
    if kind == study.EPISODES:
      return [*map(_training, _records(gains[seed]))]
    return []

  return read


def _no_trace(folder: pathlib.Path, unused_seed: int) -> dict[str, Any]:
  raise errors.ResultsError(
      f'{folder}: published results have no actions; run the experiment for'
      ' films and paths'
  )


def _rows_of(
    sweep: study.Study, run: study.Run, folders: Mapping[int, str]
) -> Iterator[dict[str, Any]]:
  """Yields the rows of a run as records.

  Args:
    sweep: The sweep.
    run: The run.
    folders: Names of the folders of its jobs, by seed.
  """
  by_seed = {run.evaluation_seed(seed): folders[seed] for seed in run.configs}
  transplant = sweep.runs.get(f'{run.family}.{hacking.TRANSPLANT}')
  is_twin = transplant is not None and run.role is study.Role.TWIN
  parts = {
      'rows': run.rows,
      'transplants': transplant.rows if transplant and is_twin else (),
      'stages': run.stages,
  }
  for part, rows in parts.items():
    for row in rows:
      record = row.model_dump(by_alias=True)
      record.pop('schema')
      record['end'] = row.end.value
      yield {_JOB: by_seed[row.seed], _PART: part, **record}


def _row(
    folder: pathlib.Path, leaves: Mapping[str, Any]
) -> results.EpisodeResult:
  """Returns the row of a table's row.

  Raises:
    ResultsError: If it lacks a figure, or has another one.
  """
  figures = {
      name: value
      for name, value in leaves.items()
      if value is not None and name not in (_JOB, _PART)
  }
  path = folder / published_files.ROWS
  with storage.fitting(path):
    record = published_files.nested(figures)
  return sweep_folders.validated(results.EpisodeResult, record, path)


def _by_job(
    path: pathlib.Path, published: _Published
) -> dict[str, list[dict[str, Any]]]:
  """Returns the rows of a table by the folder of their job.

  Raises:
    ResultsError: If the file cannot be read, or a row is of no finished job.
  """
  by_job: dict[str, list[dict[str, Any]]] = {}
  for leaves in published_files.read_table(path):
    if (job := str(leaves.pop(_JOB, None))) not in published.done:
      raise errors.ResultsError(
          f'{path}: a row of {_JOB} {job!r}; must be one of the'
          f' {len(published.done)} finished ones'
      )
    by_job.setdefault(job, []).append(leaves)
  return by_job


def _records(rows: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
  """Yields the records of a job, with the same keys in all of them."""
  names = {
      name
      for leaves in rows
      for name, value in leaves.items()
      if value is not None or '/' not in name
  }
  for leaves in rows:
    yield published_files.nested(
        {name: value for name, value in leaves.items() if name in names}
    )


def _training(record: Mapping[str, Any]) -> dict[str, Any]:
  """Returns the record of training episodes of which the gains are known."""
  gains = record.get('gains', {})
  return {
      **record,
      'objective': {
          name: (None, None) if gain is None else (gain, 0.0)
          for name, gain in gains.items()
      },
  }


def _index(distinct: list[Any], value: Any) -> int:
  """Returns the index of a value in a list, which gets it if it is new."""
  if value not in distinct:
    distinct.append(value)
  return distinct.index(value)

"""Published results of a sweep: few small files, for everybody to check.

The folder has the evaluation episodes, the learning curves and the gains of
training episodes as tables, and one JSON file with the experiment, the jobs,
their configurations and the audits. Reports and scorecards read it like the
folder of a sweep. Actions are left out, so films and paths need the runs again.
"""

from collections.abc import Iterator, Mapping, Sequence
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
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import training

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
    files: Imprints of the tables; `None` in a folder of a former version.
    digest: Digest of everything else; `None` there.
  """

  schema_version: Literal[1] = pydantic.Field(_SCHEMA, alias='schema')
  experiment: dict[str, Any]
  calibration: bool
  jobs: sweep_results.Jobs
  done: dict[str, _Done] = pydantic.Field(min_length=1)
  configs: list[dict[str, Any]]
  machines: list[list[dict[str, Any]]]
  audits: dict[str, Any]
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
  sweep = sweep_results.load(folder)
  runs = sweep.runs.values()
  if not any(run.is_done for run in runs):
    raise errors.ResultsError(f'{folder}: no job has finished yet')
  rows: list[dict[str, Any]] = []
  points: list[dict[str, Any]] = []
  episodes: list[dict[str, Any]] = []
  configs: list[dict[str, Any]] = []
  machines: list[list[dict[str, Any]]] = []
  done = {}
  for run in runs:
    rows += _rows_of(run)
    folders = {job.seed: job.folder for job in run.jobs}
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
          run.lines(seed, training.TRAINING_EPISODES), curve
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
      'jobs': [job.model_dump() for run in runs for job in run.jobs],
      'done': done,
      'configs': configs,
      'machines': machines,
      'audits': sweep.audits,
  }
  content[storage.FILES] = {
      name: storage.imprint(output / name, len(records))
      for name, records in tables.items()
  }
  content['digest'] = validation.digest_of(content)
  text = json.dumps(content, separators=(',', ':')) + '\n'
  storage.write_whole(output / sweep_results.CONTENTS, text.encode())
  return len(done), len(sweep.unfinished)


def load(folder: pathlib.Path) -> sweep_results.Sweep:
  """Reads published results; see `result_folders.load`.

  Raises:
    ResultsError: If a file is missing or damaged. The message names it.
  """
  path = folder / sweep_results.CONTENTS
  content = storage.read_json(path)
  published = sweep_results.validated(_Published, content, path)
  tables = {
      name: _by_job(folder / name, published) for name in published_files.TABLES
  }
  rows, points, gains = tables.values()
  runs = {}
  for name, of_run in sweep_results.by_run(published.jobs).items():
    finished = [job for job in of_run if job.folder in published.done]
    configs = {
        job.seed: {
            **published.configs[published.done[job.folder].config],
            'seed': job.seed,
        }
        for job in finished
    }
    files = dict.fromkeys(sweep_results.PARTS, folder / published_files.ROWS)
    parts: sweep_results.Parts = {part: [] for part in files}
    for job in finished:
      of_job: sweep_results.Parts = {part: [] for part in files}
      for leaves in rows.get(job.folder, ()):
        if leaves.get(_PART) not in parts:
          raise errors.ResultsError(
              f'{folder / published_files.ROWS}: {_PART} is'
              f' {leaves.get(_PART)!r}; must be one of {list(parts)}'
          )
        of_job[leaves[_PART]].append(_row(folder, leaves))
      sweep_results.check_job(path, files, job, configs[job.seed], of_job)
      for part, of_part in of_job.items():
        parts[part] += of_part
    for part in ('rows', 'transplants'):
      sweep_results.check_stakes(folder, name, parts[part])
    runs[name] = sweep_results.Run(
        name=name,
        jobs=tuple(of_run),
        lines=_lines(
            {job.seed: points.get(job.folder, []) for job in finished},
            {job.seed: gains.get(job.folder, []) for job in finished},
        ),
        trace=functools.partial(_no_trace, folder),
        configs=configs,
        **{part: tuple(part_rows) for part, part_rows in parts.items()},
    )
  return sweep_results.Sweep(
      folder,
      published.experiment,
      published.calibration,
      runs,
      tuple(job for job in published.jobs if job.folder not in published.done),
      published.audits,
      has_traces=False,
      has_imprints=_is_as_published(path, content, tables),
  )


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


def _lines(
    points: Mapping[int, Sequence[Mapping[str, Any]]],
    gains: Mapping[int, Sequence[Mapping[str, Any]]],
) -> sweep_results.Lines:
  """Returns the reader of the records of a run."""

  def lines(seed: int, name: str) -> list[dict[str, Any]]:
    if name == training.CURVE:
      return [*_records(points[seed])]
    if name == training.TRAINING_EPISODES:
      return [*map(_training, _records(gains[seed]))]
    return []

  return lines


def _no_trace(folder: pathlib.Path, unused_seed: int) -> dict[str, Any]:
  raise errors.ResultsError(
      f'{folder}: published results have no actions; run the experiment for'
      ' films and paths'
  )


def _rows_of(run: sweep_results.Run) -> Iterator[dict[str, Any]]:
  """Yields the rows of a run as records."""
  folders = {
      run.evaluation_seed(job.seed): job.folder
      for job in run.jobs
      if job.seed in run.configs
  }
  for part in sweep_results.PARTS:
    for row in getattr(run, part):
      record = row.model_dump(by_alias=True)
      record.pop('schema')
      record['end'] = row.end.value
      yield {_JOB: folders[row.seed], _PART: part, **record}


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
  return sweep_results.validated(results.EpisodeResult, record, path)


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

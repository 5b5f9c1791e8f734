"""Packed sweeps: the finished jobs of a sweep in one file.

A packed sweep is a zip file without dates, so the same results give the same
bytes. Its last member is a manifest with the SHA-256 of all others. `unpack`
verifies all members in a temporary folder, and then moves whole folders to
their places.
"""

from collections.abc import Mapping
import hashlib
import io
import json
import os
import pathlib
import re
import stat
import tempfile
from typing import Final
import zipfile

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.experiments import curves
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.experiments import training

MANIFEST: Final = 'manifest.json'
_SCHEMA = 1
_SUFFIX = '.zip'
_NAME = r'\w[\w.-]*'
# Files of the sweep, of a job or of an audit. No name leads elsewhere.
_MEMBER = re.compile(rf'{_NAME}(/{_NAME})?', re.ASCII)
_UNIX = 3


def pack(
    folder: pathlib.Path, output: pathlib.Path, *, learners: bool = False
) -> tuple[int, int]:
  """Writes the finished jobs of a sweep into a file, and replaces the file.

  Checkpoints, logs and times are left out, and by default trained learners. Of
  training episodes, the file has the part that reports need.

  Args:
    folder: Folder of the sweep, which may still be running.
    output: File to write, with the suffix `.zip`.
    learners: True to include trained learners.

  Returns:
    The numbers of packed and of unfinished jobs.

  Raises:
    ResultsError: If no job has finished, a file of the sweep is missing or
      damaged, or the output cannot be written.
  """
  if output.suffix != _SUFFIX:
    raise errors.ResultsError(f'{output}: allowed are names with {_SUFFIX}')
  planned = _folders(folder)
  finished = [name for name in planned if jobs.is_done(folder / name)]
  if not finished:
    raise errors.ResultsError(f'{folder}: no job has finished yet')
  paths = [folder / scheduler.SWEEP, folder / scheduler.EXPERIMENT]
  paths += (folder / scheduler.AUDITS).glob('*.json')
  files = {}
  for job in finished:
    done = storage.read_done(folder / job / storage.DONE)
    if training.TRAINING_EPISODES in done:
      files[f'{job}/{training.TRAINING_GAINS}'] = _gains(folder / job)
    kept = done.keys() - {training.TRAINING_EPISODES}
    if not learners:
      kept.discard(training.LEARNER)
    paths += (folder / job / name for name in (storage.CONFIG, *kept))
  for path in paths:
    with storage.explained(path):
      files[path.relative_to(folder).as_posix()] = path.read_bytes()
  for job in finished:
    files[f'{job}/{storage.DONE}'] = _done(folder / job, job, files)
  with storage.explained(output.parent):
    output.parent.mkdir(parents=True, exist_ok=True)
  storage.write_whole(output, _zipped(dict(sorted(files.items()))))
  return len(finished), len(planned) - len(finished)


def _gains(path: pathlib.Path) -> bytes:
  """Returns the training episodes of a job as reports need them."""
  with storage.explained(path):
    episodes, curve = (
        [json.loads(line) for line in (path / name).read_text().splitlines()]
        for name in (training.TRAINING_EPISODES, training.CURVE)
    )
  lines = [json.dumps(one) for one in curves.condensed(episodes, curve)]
  return ''.join(f'{line}\n' for line in lines).encode()


def _done(path: pathlib.Path, job: str, files: Mapping[str, bytes]) -> bytes:
  """Returns the record of a finished job without results that are not packed.

  Args:
    path: Folder of the job, with the record of all results.
    job: Name of the folder.
    files: Packed files of all jobs.
  """
  done = storage.read_sealed(path / storage.DONE, f'remove {path}')
  gains = files.get(f'{job}/{training.TRAINING_GAINS}')
  for name in (training.TRAINING_EPISODES, training.LEARNER):
    if f'{job}/{name}' not in files:
      done['files'].pop(name, None)
  if gains is not None:
    done['files'][training.TRAINING_GAINS] = _digest(gains)
  return storage.sealed(done)


def _zipped(files: Mapping[str, bytes]) -> bytes:
  """Returns a packed sweep with files."""
  digests = {name: _digest(data) for name, data in files.items()}
  manifest = {'schema': _SCHEMA, 'files': digests}
  text = json.dumps(manifest, indent=2, sort_keys=True)
  file = io.BytesIO()
  with zipfile.ZipFile(file, 'w') as target:
    for name, data in [*files.items(), (MANIFEST, text.encode())]:
      info = zipfile.ZipInfo(name)  # Its date is that of no file: 1980.
      info.compress_type = zipfile.ZIP_LZMA
      info.create_system = _UNIX
      info.external_attr = (stat.S_IFREG | 0o644) << 16
      target.writestr(info, data)
  return file.getvalue()


def unpack(path: pathlib.Path, output: pathlib.Path) -> tuple[int, int]:
  """Writes the jobs of a packed sweep into the folder of a sweep.

  The folder is new, or belongs to the same experiment. In the second case only
  missing jobs and audits are added; everything else stays as it is.

  Args:
    path: Packed sweep.
    output: Folder of the sweep.

  Returns:
    The numbers of jobs that were added, and of those that were there already.

  Raises:
    ResultsError: If the file is damaged or is not a packed sweep, or the folder
      contains anything else or an unfinished job of the file. Nothing changes.
  """
  with storage.explained(output):
    target = pathlib.Path(os.path.realpath(output))
    is_new = not target.exists() or not any(target.iterdir())
    if not is_new and not (target / scheduler.SWEEP).is_file():
      raise errors.ResultsError(
          f'{output}: not empty, and not the folder of a sweep; name a new'
          ' folder'
      )
    files = _read(path)
    parent = target.parent if is_new else target
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='.unpacking-', dir=parent) as name:
      staged = pathlib.Path(name) / 'sweep'
      try:
        found = _stage(files, staged)
      except errors.RealabError as error:
        # The temporary folder means nothing to the user.
        problem = str(error).replace(f'{staged}{os.sep}', '')
        raise errors.ResultsError(f'{path}: {problem}') from error
      if not is_new:
        return _merge(path, staged, found, target)
      os.rename(staged, target)
  return len(found), 0


def _read(path: pathlib.Path) -> dict[str, bytes]:
  """Returns the contents of the files of a packed sweep.

  Raises:
    ResultsError: If it is not a packed sweep, or is damaged.
  """
  try:
    with storage.explained(path), zipfile.ZipFile(path) as source:
      files = {name: source.read(name) for name in source.namelist()}
    manifest = json.loads(files.pop(MANIFEST))
    schema, digests = manifest['schema'], dict(manifest['files'])
  except errors.RealabError:
    raise
  except Exception as error:  # Damage raises errors of many libraries.
    raise errors.ResultsError(
        f'{path}: damaged, or not a packed sweep: {error}'
    ) from error
  if schema != _SCHEMA:
    raise errors.ResultsError(
        f'{path}: {MANIFEST!r} schema is {schema!r:.40}; allowed is {_SCHEMA}'
    )
  for name in sorted(files.keys() | digests.keys()):
    problem = ''
    if not _MEMBER.fullmatch(name):
      problem = 'is not the name of a file of a sweep'
    elif name not in files:
      problem = 'is missing'
    elif name not in digests:
      problem = f'is not in {MANIFEST!r}'
    elif _digest(files[name]) != digests[name]:
      problem = 'changed since the sweep was packed'
    if problem:
      raise errors.ResultsError(f'{path}: {name!r:.80} {problem}')
  return files


def _stage(files: Mapping[str, bytes], folder: pathlib.Path) -> list[str]:
  """Writes files into a new folder, and returns the names of its jobs.

  Raises:
    ResultsError: If the folder is not that of a sweep with finished jobs.
  """
  for name, data in files.items():
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data)
  found = [
      name for name in _folders(folder) if f'{name}/{storage.CONFIG}' in files
  ]
  for job in found:
    # Until version 0.2, records listed results that had not been packed.
    storage.write_whole(
        folder / job / storage.DONE, _done(folder / job, job, files)
    )
    jobs.is_done(folder / job)  # Verifies its results.
  return found


def _merge(
    path: pathlib.Path,
    staged: pathlib.Path,
    found: list[str],
    target: pathlib.Path,
) -> tuple[int, int]:
  """Moves missing jobs and audits into the folder of a sweep."""
  scheduler.check_experiment(
      target,
      loading.read_mapping(staged / scheduler.EXPERIMENT),
      scheduler.read_description(staged)['calibration'],
  )
  planned = _folders(target)
  missing = []
  for name in found:
    if name not in planned:
      raise errors.ResultsError(
          f'{target / scheduler.SWEEP}: has no job {name}, which {path}'
          ' contains; name another folder'
      )
    if jobs.is_done(target / name):
      continue
    if (target / name).exists():
      raise errors.ResultsError(
          f'{target / name}: an unfinished job, which {path} contains as a'
          ' finished one; remove this folder, or name another one'
      )
    missing.append(name)
  audits = [
      name
      for audit in staged.glob(f'{scheduler.AUDITS}/*')
      if not (target / (name := f'{scheduler.AUDITS}/{audit.name}')).exists()
  ]
  with storage.locked(target):
    for name in (*missing, *audits):
      (target / name).parent.mkdir(exist_ok=True)
      os.rename(staged / name, target / name)
  return len(missing), len(found) - len(missing)


def _folders(folder: pathlib.Path) -> list[str]:
  """Returns the names of the folders of all jobs of a sweep.

  Raises:
    ResultsError: If the description of the sweep is damaged.
  """
  description = scheduler.read_description(folder)
  scheduler.read_experiment(folder, description)
  return [job['folder'] for job in description['jobs']]


def _digest(data: bytes) -> str:
  return hashlib.sha256(data).hexdigest()

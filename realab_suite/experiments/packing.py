"""Packed sweeps: the finished jobs of a sweep in one file.

A packed sweep is a zip file without dates, so the same results give the same
bytes. Its last member is a manifest with the SHA-256 of all others. Packed
sweeps may come from anywhere: `unpack` writes no file before it has checked the
names, the sizes and the contents of all members, and then moves whole folders
to their places.
"""

from collections.abc import Iterable, Mapping
import hashlib
import io
import json
import os
import pathlib
import re
import stat
import tempfile
from typing import Any, Final, NamedTuple, final
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
# Contents are held in memory.
_MAX_BYTES = 1 << 30
# The decompressor has no limit on its output, so it gets small parts.
_CHUNK = 1 << 12
_UNIX = 3


@final
class Counts(NamedTuple):
  """Numbers of jobs.

  Attributes:
    done: Number of jobs that were packed, or added by unpacking.
    others: Number of unfinished jobs, or of jobs that were there already.
  """

  done: int
  others: int


def pack(
    folder: pathlib.Path, output: pathlib.Path, *, learners: bool = False
) -> Counts:
  """Writes the finished jobs of a sweep into a file, and replaces the file.

  Checkpoints, logs and times are left out, and by default trained learners. Of
  training episodes, the file has the part that reports need.

  Args:
    folder: Folder of the sweep, which may still be running.
    output: File to write, with the suffix `.zip`.
    learners: True to include trained learners.

  Raises:
    ResultsError: If no job has finished, a file of the sweep is missing or
      damaged, or the output cannot be written.
  """
  if output.suffix != _SUFFIX:
    raise errors.ResultsError(f'{output}: allowed are names with {_SUFFIX}')
  planned, audits = _read_sweep(folder)
  finished = [name for name in planned if jobs.is_done(folder / name)]
  if not finished:
    raise errors.ResultsError(f'{folder}: no job has finished yet')
  names = [scheduler.SWEEP, scheduler.EXPERIMENT]
  names += [name for name in audits if (folder / name).exists()]
  files, left_out = {}, {}
  for job in finished:
    done = storage.read_done(folder / job / storage.DONE)
    for name in {storage.CONFIG, storage.DONE, *done}:
      if name == storage.TRAINING_EPISODES or (
          name == storage.LEARNER and not learners
      ):
        left_out[f'{job}/{name}'] = done[name]
      else:
        storage.result_path(folder / job, name)
        names.append(f'{job}/{name}')
    if storage.TRAINING_EPISODES in done:
      files[f'{job}/{storage.TRAINING_GAINS}'] = _gains(folder / job)
  for name in sorted(names):
    with storage.explained(folder / name):
      files[name] = (folder / name).read_bytes()
  _refuse_size(folder, map(len, files.values()))
  with storage.explained(output.parent):
    output.parent.mkdir(parents=True, exist_ok=True)
  files = dict(sorted(files.items()))
  storage.write_whole(output, _zipped(files, left_out))
  return Counts(len(finished), len(planned) - len(finished))


def _gains(path: pathlib.Path) -> bytes:
  """Returns the training episodes of a job as reports need them."""
  with storage.explained(path):
    if (path / storage.TRAINING_GAINS).exists():  # From a packed sweep.
      return (path / storage.TRAINING_GAINS).read_bytes()
    episodes, curve = (
        [json.loads(line) for line in (path / name).read_text().splitlines()]
        for name in (storage.TRAINING_EPISODES, training.CURVE)
    )
  lines = [json.dumps(one) for one in curves.condensed(episodes, curve)]
  return ''.join(f'{line}\n' for line in lines).encode()


def _zipped(files: Mapping[str, bytes], left_out: Mapping[str, str]) -> bytes:
  """Returns a packed sweep with files, and with the digests of others."""
  digests = {name: _digest(data) for name, data in files.items()}
  manifest = {'schema': _SCHEMA, 'files': digests, 'left_out': left_out}
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


def unpack(path: pathlib.Path, output: pathlib.Path) -> Counts:
  """Writes the jobs of a packed sweep into the folder of a sweep.

  The folder is new, or belongs to the same experiment. In the second case only
  missing jobs and audits are added; everything else stays as it is.

  Args:
    path: Packed sweep.
    output: Folder of the sweep.

  Raises:
    ResultsError: If the file is damaged or is not a packed sweep, or the folder
      contains anything else or an unfinished job of the file. Nothing changes.
  """
  files, left_out = _read(path)
  with storage.explained(output):
    target = pathlib.Path(os.path.realpath(output))
    is_new = not target.exists() or not any(target.iterdir())
    if not is_new and not (target / scheduler.SWEEP).is_file():
      raise errors.ResultsError(
          f'{output}: not empty, and not the folder of a sweep; name a new'
          ' folder'
      )
    parent = target.parent if is_new else target
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='.unpacking-', dir=parent) as name:
      staged = pathlib.Path(name) / 'sweep'
      try:
        found = _stage(files, left_out, staged)
      except errors.RealabError as error:
        # The temporary folder means nothing to the user.
        problem = str(error).replace(f'{staged}{os.sep}', '')
        raise errors.ResultsError(f'{path}: {problem}') from error
      if not is_new:
        return _merge(path, staged, found, target)
      os.rename(staged, target)
  return Counts(len(found), 0)


def _stage(
    files: Mapping[str, bytes],
    left_out: Mapping[str, str],
    folder: pathlib.Path,
) -> list[str]:
  """Writes files into a new folder, and returns the names of its jobs.

  Raises:
    ResultsError: If the folder is not that of a sweep with finished jobs.
  """
  for name, data in files.items():
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data)
  planned, _ = _read_sweep(folder)
  found = [name for name in planned if (folder / name).is_dir()]
  for job in found:
    missing = {
        name: left_out[f'{job}/{name}']
        for name in sorted(storage.LEAVABLE)
        if f'{job}/{name}' in left_out
    }
    if missing:
      gains = f'{job}/{storage.TRAINING_GAINS}'
      added = (
          {storage.TRAINING_GAINS: _digest(files[gains])}
          if gains in files
          else {}
      )
      storage.write_sealed(
          folder / job / storage.LEFT_OUT, {'files': missing, 'added': added}
      )
    if not jobs.is_done(folder / job):
      raise errors.ResultsError(f'{folder / job / storage.DONE}: missing')
  return found


def _merge(
    path: pathlib.Path,
    staged: pathlib.Path,
    found: list[str],
    target: pathlib.Path,
) -> Counts:
  """Moves missing jobs and audits into the folder of a sweep."""
  scheduler.check_experiment(
      target,
      loading.read_mapping(staged / scheduler.EXPERIMENT),
      scheduler.read_description(staged)['calibration'],
  )
  planned, _ = _read_sweep(target)
  missing = []
  for name in found:
    if name not in planned:
      raise errors.ResultsError(
          f'{target / scheduler.SWEEP}: has no job {name}, which {path}'
          ' contains; name another folder'
      )
    if jobs.is_done(target / name):
      continue
    if os.path.lexists(target / name):
      raise errors.ResultsError(
          f'{target / name}: an unfinished job, which {path} contains as a'
          ' finished one; remove this folder, or name another one'
      )
    missing.append(name)
  audits = [
      audit.relative_to(staged)
      for audit in staged.glob(f'{scheduler.AUDITS}/*')
      if not (target / audit.relative_to(staged)).exists()
  ]
  if missing or audits:
    lock = storage.lock(target)
    try:
      for moved in [*map(pathlib.Path, missing), *audits]:
        with storage.explained(target / moved):
          (target / moved).parent.mkdir(exist_ok=True)
          os.rename(staged / moved, target / moved)
    finally:
      os.close(lock)
  return Counts(len(missing), len(found) - len(missing))


def _read_sweep(folder: pathlib.Path) -> tuple[list[str], list[str]]:
  """Reads and verifies the description of a sweep.

  Returns:
    The folders of all jobs, and the files of possible audits, by their names
    in the folder of the sweep.

  Raises:
    ResultsError: If it is damaged, or a name leads out of the folder.
  """
  description: Any = scheduler.read_description(folder)
  scheduler.read_experiment(folder, description)
  try:
    folders = [str(job['folder']) for job in description['jobs']]
    runs = {str(job['run']): None for job in description['jobs']}
  except (LookupError, TypeError) as error:
    raise errors.ResultsError(
        f'{folder / scheduler.SWEEP}: jobs: malformed: {error!r:.80}'
    ) from error
  for name in [*folders, *runs]:
    if not _MEMBER.fullmatch(name) or '/' in name:
      raise errors.ResultsError(
          f'{folder / scheduler.SWEEP}: {name!r:.80} is not the name of a job'
      )
  return folders, [f'{scheduler.AUDITS}/{run}.json' for run in runs]


def _read(path: pathlib.Path) -> tuple[dict[str, bytes], dict[str, str]]:
  """Reads and verifies a packed sweep.

  Returns:
    The contents of its files, and the SHA-256 of those that were left out.

  Raises:
    ResultsError: If it is not a packed sweep, or is damaged.
  """
  try:
    with storage.explained(path):
      # To open a pipe may take for ever, and so may to read a device.
      if not path.is_file() and path.exists():
        raise errors.ResultsError(
            f'{path}: not a regular file; allowed is a packed sweep'
        )
      with zipfile.ZipFile(path) as source:
        _check_members(path, source.infolist())
        files = {name: _contents(source, name) for name in source.namelist()}
    manifest = json.loads(files.pop(MANIFEST))
    schema, digests, left_out = (
        manifest.get(key) for key in ('schema', 'files', 'left_out')
    )
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
  if not isinstance(digests, dict) or not isinstance(left_out, dict):
    raise errors.ResultsError(f'{path}: {MANIFEST!r} has no SHA-256 of files')
  for name in sorted(files.keys() | digests.keys()):
    if name not in files or name not in digests:
      problem = 'is not in the manifest' if name in files else 'is missing'
      raise errors.ResultsError(f'{path}: {name!r:.80} {problem}')
    if _digest(files[name]) != digests[name]:
      raise errors.ResultsError(
          f'{path}: {name!r} changed since the sweep was packed'
      )
  return files, left_out


def _check_members(path: pathlib.Path, members: list[zipfile.ZipInfo]) -> None:
  """Checks the names, kinds and sizes of the members of a zip file."""
  for member in members:
    name, problem = member.orig_filename, ''
    if member.filename != name or not _MEMBER.fullmatch(name):
      problem = 'is not the name of a file of a sweep'
    elif not stat.S_ISREG(member.external_attr >> 16):
      problem = 'is not a regular file'
    if problem:
      raise errors.ResultsError(f'{path}: {name!r:.80} {problem}')
  _refuse_size(path, (member.file_size for member in members))


def _refuse_size(path: pathlib.Path, sizes: Iterable[int]) -> None:
  if (size := sum(sizes)) > _MAX_BYTES:
    raise errors.ResultsError(
        f'{path}: has {size} bytes of contents; allowed are {_MAX_BYTES}'
    )


def _contents(source: zipfile.ZipFile, name: str) -> bytes:
  with source.open(name) as file:
    return b''.join(iter(lambda: file.read(_CHUNK), b''))


def _digest(data: bytes) -> str:
  return hashlib.sha256(data).hexdigest()

"""Packed sweeps: the finished jobs of a sweep in one file.

A packed sweep is a zip file without dates, so the same results give the same
bytes. Its last member is a manifest with the SHA-256 of all others. Packed
sweeps may come from anywhere: `unpack` writes no file before it has checked the
names, the sizes and the contents of all members, and then moves whole folders
to their places.
"""

from collections.abc import Iterator
import contextlib
import hashlib
import io
import itertools
import json
import lzma
import os
import pathlib
import re
import stat
import tempfile
from typing import Any, Final, NamedTuple, final
import zipfile

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage

MANIFEST: Final = 'manifest.json'
_SCHEMA = 1
_SUFFIX = '.zip'
_NAME = r'\w[\w.-]*'
# Files of the sweep, of a job or of an audit. No name leads elsewhere.
_MEMBER = re.compile(rf'{_NAME}(/{_NAME})?', re.ASCII)
_MAX_MEMBER_BYTES = 1 << 28
_MAX_BYTES = 1 << 32
# The decompressor has no limit on its output, so it gets small parts.
_CHUNK = 1 << 12
_FILE_MODE = stat.S_IFREG | 0o644
_UNIX = 3
# Errors of the libraries that read a zip file, if it is damaged or forged.
_MALFORMED = (
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    RecursionError,
    RuntimeError,
    ValueError,
    lzma.LZMAError,
    zipfile.BadZipFile,
)


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

  Checkpoints, logs and times are left out, and by default trained learners.

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
  sweep = _read_sweep(folder)
  finished = [name for name in sweep.jobs if jobs.is_done(folder / name)]
  if not finished:
    raise errors.ResultsError(f'{folder}: no job has finished yet')
  names = [scheduler.SWEEP, scheduler.EXPERIMENT]
  names += [name for name in sweep.audits if (folder / name).exists()]
  left_out = {}
  for job in finished:
    done = storage.read_done(folder / job / storage.DONE)
    for name in {storage.CONFIG, storage.DONE, *done}:
      if name == storage.LEARNER and not learners:
        left_out[f'{job}/{name}'] = done[name]
      else:
        storage.result_path(folder / job, name)
        names.append(f'{job}/{name}')
  data = _zipped(folder, sorted(names), left_out)
  with storage.explained(output.parent):
    output.parent.mkdir(parents=True, exist_ok=True)
  storage.write_whole(output, data)
  return Counts(len(finished), len(sweep.jobs) - len(finished))


def _zipped(
    folder: pathlib.Path, names: list[str], left_out: dict[str, str]
) -> bytes:
  """Returns a packed sweep with files of a folder."""
  file, digests = io.BytesIO(), {}
  with zipfile.ZipFile(file, 'w') as target:
    for name in names:
      path = folder / name
      with storage.explained(path):
        data = path.read_bytes()
      if len(data) > _MAX_MEMBER_BYTES:
        raise errors.ResultsError(
            f'{path}: has {len(data)} bytes; allowed are {_MAX_MEMBER_BYTES}'
        )
      digests[name] = hashlib.sha256(data).hexdigest()
      _add(target, name, data)
    manifest = {'schema': _SCHEMA, 'files': digests, 'left_out': left_out}
    text = json.dumps(manifest, indent=2, sort_keys=True)
    _add(target, MANIFEST, text.encode())
  return file.getvalue()


def _add(target: zipfile.ZipFile, name: str, data: bytes) -> None:
  info = zipfile.ZipInfo(name)  # Its date is that of no file: 1980.
  info.compress_type = zipfile.ZIP_LZMA
  info.create_system = _UNIX
  info.external_attr = _FILE_MODE << 16
  target.writestr(info, data)


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
  with _opened(path) as packed:
    for name in packed.digests:
      packed.read(name)
    with storage.explained(output):
      target = pathlib.Path(os.path.realpath(output))
      is_new = not target.exists() or not any(target.iterdir())
    if not is_new and not (target / scheduler.SWEEP).is_file():
      raise errors.ResultsError(
          f'{output}: not empty, and not the folder of a sweep; name a new'
          ' folder'
      )
    with _temporary(target.parent if is_new else target) as staged:
      found = packed.stage(staged)
      if not is_new:
        return _merge(path, staged, found, target)
      with storage.explained(output):
        os.rename(staged, target)
  return Counts(len(found), 0)


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
  planned = _read_sweep(target).jobs
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


@contextlib.contextmanager
def _temporary(parent: pathlib.Path) -> Iterator[pathlib.Path]:
  """Yields a path in a folder that is removed at the end."""
  with contextlib.ExitStack() as stack:
    with storage.explained(parent):
      parent.mkdir(parents=True, exist_ok=True)
      folder = stack.enter_context(
          tempfile.TemporaryDirectory(prefix='.unpacking-', dir=parent)
      )
    yield pathlib.Path(folder) / 'sweep'


@final
class _Sweep(NamedTuple):
  """Names in the description of a sweep.

  Attributes:
    jobs: Folders of all jobs.
    audits: Files of possible audits, relative to the folder of the sweep.
  """

  jobs: list[str]
  audits: list[str]


def _read_sweep(folder: pathlib.Path) -> _Sweep:
  """Reads and verifies the description of a sweep.

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
  return _Sweep(folders, [f'{scheduler.AUDITS}/{run}.json' for run in runs])


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator['_Packed']:
  """Opens a packed sweep and checks the names and sizes of its members.

  Raises:
    ResultsError: If it is not a packed sweep, or is damaged.
  """
  with storage.explained(path), contextlib.ExitStack() as stack:
    file = stack.enter_context(open(path, 'rb'))
    with _intact(path):
      source = stack.enter_context(zipfile.ZipFile(file))
      packed = _Packed(path, source)
    yield packed


@contextlib.contextmanager
def _intact(path: pathlib.Path, name: str = '') -> Iterator[None]:
  """Turns errors of the libraries that read zip files into one line."""
  try:
    yield
  except errors.RealabError:
    raise
  except _MALFORMED as error:
    where = f'{path}: {name}' if name else f'{path}'
    raise errors.ResultsError(
        f'{where}: damaged, or not a packed sweep: {error}'
    ) from error


@final
class _Packed:
  """An open packed sweep whose names and sizes have been checked.

  Attributes:
    digests: SHA-256 of each file, by its name.
  """

  def __init__(self, path: pathlib.Path, source: zipfile.ZipFile) -> None:
    self._path = path
    self._source = source
    members = source.infolist()
    for member in members:
      if problem := _problem(member):
        raise self._error(member.orig_filename, problem)
    names = sorted(member.filename for member in members)
    for name, following in itertools.pairwise(names):
      if name == following:
        raise self._error(name, 'is there twice')
    if sum(member.file_size for member in members) > _MAX_BYTES:
      raise errors.ResultsError(
          f'{path}: has more than {_MAX_BYTES} bytes of contents'
      )
    self.digests, self._left_out = self._manifest()
    for name in sorted({*names} ^ {*self.digests, MANIFEST}):
      raise self._error(
          name, 'is not in the manifest' if name in names else 'is missing'
      )

  def read(self, name: str) -> bytes:
    """Returns the contents of a file, after checking its SHA-256."""
    data = self._contents(name)
    if hashlib.sha256(data).hexdigest() != self.digests[name]:
      raise self._error(name, 'changed since the sweep was packed')
    return data

  def stage(self, folder: pathlib.Path) -> list[str]:
    """Writes all files into a new folder, and returns the names of the jobs.

    Raises:
      ResultsError: If the folder would not be that of a sweep with finished
        jobs.
    """
    with storage.explained(self._path):
      for name in self.digests:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with open(folder / name, 'xb') as file:
          file.write(self.read(name))
    try:
      return self._check(folder)
    except errors.RealabError as error:
      # The temporary folder means nothing to the user.
      problem = str(error).replace(f'{folder}{os.sep}', '')
      raise errors.ResultsError(f'{self._path}: {problem}') from error

  def _check(self, folder: pathlib.Path) -> list[str]:
    """Checks the files of a folder, and marks what was left out."""
    sweep = _read_sweep(folder)
    found = [name for name in sweep.jobs if (folder / name).is_dir()]
    expected = {scheduler.SWEEP, scheduler.EXPERIMENT, *sweep.audits}
    for job in found:
      learner = f'{job}/{storage.LEARNER}'
      if digest := self._left_out.get(learner):
        storage.write_sealed(
            folder / job / storage.LEFT_OUT,
            {'files': {storage.LEARNER: digest}},
        )
      if not jobs.is_done(folder / job):
        raise self._error(f'{job}/{storage.DONE}', 'is missing')
      done = storage.read_done(folder / job / storage.DONE)
      own = {storage.CONFIG, storage.DONE, *done}
      expected |= {f'{job}/{name}' for name in own}
    for name in sorted({*self.digests, *self._left_out} - expected):
      raise self._error(name, 'does not belong to a job of the sweep')
    return found

  def _manifest(self) -> tuple[dict[str, str], dict[str, str]]:
    content: Any = json.loads(self._contents(MANIFEST))
    schema = content.get('schema') if isinstance(content, dict) else None
    if schema != _SCHEMA:
      raise self._error(
          MANIFEST, f'schema is {schema!r:.40}; allowed is {_SCHEMA}'
      )
    parts = content.get('files'), content.get('left_out')
    for part in parts:
      if not isinstance(part, dict) or not all(
          isinstance(digest, str) for digest in part.values()
      ):
        raise self._error(MANIFEST, 'has no SHA-256 of each file')
    return parts

  def _contents(self, name: str) -> bytes:
    with _intact(self._path, name), self._source.open(name) as file:
      return b''.join(iter(lambda: file.read(_CHUNK), b''))

  def _error(self, name: str, problem: str) -> errors.ResultsError:
    return errors.ResultsError(f'{self._path}: {name!r:.80} {problem}')


def _problem(member: zipfile.ZipInfo) -> str:
  """Returns the reason for not reading a member, or ''."""
  if member.filename != member.orig_filename or not _MEMBER.fullmatch(
      member.filename
  ):
    return 'is not the name of a file of a sweep'
  if stat.S_IFMT(member.external_attr >> 16) != stat.S_IFREG:
    return 'is not a regular file'
  if member.compress_type != zipfile.ZIP_LZMA:
    return 'is not compressed as `pack` does'
  if member.file_size > _MAX_MEMBER_BYTES:
    return f'has {member.file_size} bytes; allowed are {_MAX_MEMBER_BYTES}'
  return ''

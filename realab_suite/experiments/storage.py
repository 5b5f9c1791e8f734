"""Folders of runs: locked, written whole or not at all, never mixed up."""

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import errno
import fcntl
import hashlib
import json
import os
import pathlib
import re
from typing import Any, final

from realab_suite import archive
from realab_suite import errors
from realab_suite.config import validation

CONFIG = 'config.json'
DONE = 'done.json'
_LOCK = 'lock'
_CHECKPOINTS = 'checkpoints'
_SUFFIX = '.ckpt'
_KEPT = 2  # Checkpoints: the last one, and the one before.
_CHUNK = 1 << 20


@contextlib.contextmanager
def explained(path: str | os.PathLike[str]) -> Iterator[None]:
  """Turns what an operating system says of a file into one line for people.

  Raises:
    ResultsError: Instead of an `OSError`.
  """
  try:
    yield
  except OSError as error:
    advice = ''
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
      advice = (
          '; nothing that was complete is lost: make room, then run the same'
          ' command again'
      )
    raise errors.ResultsError(
        f'{os.fspath(path)}: {error.strerror or error}{advice}'
    ) from error


def lock(folder: pathlib.Path) -> int:
  """Returns a descriptor that holds the lock of a folder until it is closed.

  Raises:
    ResultsError: If another process has it.
  """
  path = folder / _LOCK
  with explained(path):
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
      fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
      os.truncate(descriptor, 0)
      os.write(descriptor, f'{os.getpid()}\n'.encode())
      return descriptor
    except BlockingIOError:
      holder = os.pread(descriptor, 20, 0).decode(errors='replace').strip()
      os.close(descriptor)
    except OSError:
      os.close(descriptor)
      raise
  raise errors.ResultsError(
      f'folder {folder} is being written to by process'
      f' {holder or "(unknown)"}; wait for it, or end it'
  )


def write_whole(path: pathlib.Path, data: bytes) -> None:
  """Writes a file so that at any time it is either what it was or all new.

  Raises:
    ResultsError: If it cannot be written; it is what it was then.
  """
  partial = path.with_name(f'{path.name}.partial')
  with explained(path):
    try:
      with open(partial, 'wb') as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
      os.replace(partial, path)
    except OSError:
      with contextlib.suppress(OSError):
        partial.unlink()
      raise
    _sync_folder(path.parent)


def write_json(path: pathlib.Path, content: Any) -> None:
  """Writes JSON as `write_whole` does."""
  write_whole(path, (json.dumps(content, indent=2) + '\n').encode())


def read_json(path: pathlib.Path) -> Any:
  """Returns what a file of JSON holds.

  Raises:
    ResultsError: If it cannot be read, or holds none.
  """
  with explained(path):
    text = path.read_bytes()
  try:
    return json.loads(text)
  except (ValueError, RecursionError) as error:
    raise errors.ResultsError(f'{path}: not JSON: {error}') from error


def write_archive(
    path: pathlib.Path, header: Mapping[str, Any], contents: Any
) -> None:
  """Writes an archive as `write_whole` does."""
  write_whole(path, archive.Archive(header, contents).to_bytes())


def read_archive(path: pathlib.Path, header: Mapping[str, Any]) -> Any:
  """Returns the contents of an archive.

  Args:
    path: The file.
    header: The header that it was written with.

  Raises:
    ResultsError: If it cannot be read, is damaged, or has another header; the
      message says what the file holds and what was expected.
  """
  with naming(path):
    return _contents(path, header)


@contextlib.contextmanager
def naming(path: pathlib.Path) -> Iterator[None]:
  """Names a file in an error about saved state that does not fit.

  Raises:
    ResultsError: Instead of a `StateLayoutError`.
  """
  try:
    yield
  except errors.StateLayoutError as error:
    raise errors.ResultsError(f'{path}: {error}') from error


def _contents(path: pathlib.Path, header: Mapping[str, Any]) -> Any:
  with explained(path):
    data = path.read_bytes()
  expected = repr(archive.name_of(header))
  return archive.Archive.from_bytes(data, expected).contents_for(header)


def is_done(path: pathlib.Path) -> bool:
  """Returns whether the run of a folder is over.

  Raises:
    ResultsError: If a result has been changed or removed since.
  """
  if not (path / DONE).exists():
    return False
  for name, digest in _read_done(path / DONE).items():
    if _digest(path / name) != digest:
      raise errors.ResultsError(
          f'{path / name}: not what it was when the run ended; remove {path} to'
          ' run it again'
      )
  return True


def write_done(path: pathlib.Path, content: Mapping[str, Any]) -> None:
  """Says that the run of a folder is over.

  Args:
    path: The folder.
    content: What to say; `files` are the results, with their SHA-256.
  """
  write_sealed(path / DONE, content)


def write_sealed(path: pathlib.Path, content: Mapping[str, Any]) -> None:
  """Writes JSON with a checksum, as `write_whole` does."""
  write_json(path, {**content, 'checksum': validation.digest_of(content)})


def read_sealed(path: pathlib.Path, advice: str) -> dict[str, Any]:
  """Returns what `write_sealed` wrote.

  Args:
    path: The file.
    advice: What to do if it is damaged.

  Raises:
    ResultsError: If it cannot be read, or is not what was written.
  """
  content = read_json(path)
  checksum = content.pop('checksum', '') if isinstance(content, dict) else ''
  if checksum != validation.digest_of(content):
    raise errors.ResultsError(
        f'{path}: damaged: its checksum does not agree; {advice}'
    )
  sealed: dict[str, Any] = content
  return sealed


def _read_done(path: pathlib.Path) -> dict[str, str]:
  """Returns the SHA-256 of each result, by the name of its file."""
  advice = f'remove {path.parent} to run it again'
  files: dict[str, str] = read_sealed(path, advice).get('files', {})
  for name in files:
    # A checksum is no signature: whoever made the folder has made it, too.
    if not re.fullmatch(r'\w[\w.-]*', name):
      raise errors.ResultsError(
          f'{path}: {name!r:.80} is no file of a run; {advice}'
      )
  return files


@final
class RunFolder:
  """The folder of one run, which nobody else writes to meanwhile.

  Use it as a context: the lock is let go at its end, and by the operating
  system where a process dies.
  """

  def __init__(self, path: pathlib.Path, config: Mapping[str, Any]) -> None:
    """Makes the folder, or takes up one of the same configuration.

    Args:
      path: The folder.
      config: Everything that its results depend on; JSON.

    Raises:
      ResultsError: If it cannot be made, another process has it, or it belongs
        to another configuration.
    """
    self.path = path
    with explained(path):
      path.mkdir(parents=True, exist_ok=True)
    self._lock = lock(path)
    try:
      _check_config(path / CONFIG, json.loads(json.dumps(config)))
    except BaseException:
      self.close()
      raise

  def close(self) -> None:
    """Lets the folder go."""
    os.close(self._lock)

  def __enter__(self) -> 'RunFolder':
    return self

  def __exit__(self, *unused: Any) -> None:
    self.close()

  def finish(self, names: Sequence[str], facts: Mapping[str, Any]) -> None:
    """Says that the run is over, and forgets its checkpoints.

    Args:
      names: The files that are its results.
      facts: What else to say.
    """
    files = {name: _digest(self.path / name) for name in names}
    write_done(self.path, {**facts, 'files': files})
    for checkpoint in self._checkpoints():
      with explained(checkpoint):
        checkpoint.unlink()

  def save(self, step: int, header: Mapping[str, Any], contents: Any) -> None:
    """Writes a checkpoint; the one before is kept, older ones are not.

    Args:
      step: How far the run has come.
      header: What has to agree for the checkpoint to fit.
      contents: Tuples, lists and dicts of arrays, numbers, texts and `None`.

    Raises:
      ResultsError: If it cannot be written. Those before are as they were.
    """
    folder = self.path / _CHECKPOINTS
    with explained(folder):
      folder.mkdir(exist_ok=True)
    path = folder / f'{step:012d}{_SUFFIX}'
    write_archive(path, header, contents)
    self._forget_old()

  def load(self, header: Mapping[str, Any]) -> Any:
    """Returns the contents of the last checkpoint; `None` if there is none.

    Raises:
      ResultsError: If it is damaged, or of another run. It says how to go on;
        no older one is taken unasked.
    """
    checkpoints = self._checkpoints()
    if not checkpoints:
      return None
    with self.naming_checkpoint():
      contents = _contents(checkpoints[-1], header)
    # The process that wrote it may have been killed before doing this.
    self._forget_old()
    return contents

  @contextlib.contextmanager
  def naming_checkpoint(self) -> Iterator[None]:
    """Names the last checkpoint in an error about state that does not fit.

    Raises:
      ResultsError: Instead of a `StateLayoutError`; it says how to go on.
    """
    try:
      yield
    except errors.StateLayoutError as error:
      *older, path = self._checkpoints()
      where = f'from {older[-1].name}' if older else 'from the beginning'
      raise errors.ResultsError(
          f'{path}: no checkpoint of this run: {error}; remove this file, then'
          f' the same command goes on {where}'
      ) from error

  def _forget_old(self) -> None:
    for old in self._checkpoints()[:-_KEPT]:
      with explained(old):
        old.unlink()

  def _checkpoints(self) -> list[pathlib.Path]:
    """Returns the checkpoints, the last one last."""
    return sorted((self.path / _CHECKPOINTS).glob(f'*{_SUFFIX}'))


# How many bytes of a file of lines count, and their SHA-256.
Mark = Mapping[str, Any]
NOTHING: Mark = {'size': 0, 'sha256': hashlib.sha256().hexdigest()}


@final
class JsonLines:
  """A file that grows by lines of JSON, and can be cut back to a checkpoint."""

  def __init__(self, path: pathlib.Path, mark: Mark | None = None) -> None:
    """Opens the file, or makes it.

    Args:
      path: The file.
      mark: How far it counts: what is behind that was written after the
        checkpoint, and goes. `None` for all whole lines, whatever they are.

    Raises:
      ResultsError: If it cannot be opened, is shorter, or is not what it was.
    """
    self._path = path
    self._hash = hashlib.sha256()
    with explained(path), contextlib.ExitStack() as stack:
      self._file = stack.enter_context(open(path, 'a+b', buffering=0))
      self._cut_back(mark)
      stack.pop_all()

  def _cut_back(self, mark: Mark | None) -> None:
    """Removes everything behind the mark, or half a line; see `__init__`."""
    self._file.seek(0)
    if mark is None:
      whole = self._file.read().rfind(b'\n') + 1
      self._file.truncate(whole)
      return
    size = mark['size']
    while rest := size - self._file.tell():
      data = self._file.read(min(rest, _CHUNK))
      if not data:
        break
      self._hash.update(data)
    here = self._file.tell()
    problem = ''
    if here < size:
      problem = f'has {here} bytes, and the checkpoint knows of {size}'
    elif self._hash.hexdigest() != mark['sha256']:
      problem = 'not what it was when the checkpoint was written'
    if problem:
      raise errors.ResultsError(
          f'{self._path}: {problem}; remove {self._path.parent} to run it again'
      )
    self._file.truncate(size)

  def append(self, records: Sequence[Mapping[str, Any]]) -> None:
    """Adds a line for each record.

    Raises:
      ResultsError: If the disk is full. A part of a line may be there then,
        which the next run cuts off.
    """
    lines = (json.dumps(record, allow_nan=False) + '\n' for record in records)
    rest = ''.join(lines).encode()
    self._hash.update(rest)
    with explained(self._path):
      while rest:
        rest = rest[self._file.write(rest) :]

  def sync(self) -> dict[str, Any]:
    """Sees to it that all lines are on the disk; returns the mark of the end.

    It counts for a file that was opened with a mark.
    """
    with explained(self._path):
      os.fsync(self._file.fileno())
      size = self._file.tell()
    return {'size': size, 'sha256': self._hash.hexdigest()}

  def close(self) -> None:
    """Closes the file."""
    self._file.close()


def _check_config(path: pathlib.Path, config: dict[str, Any]) -> None:
  """Writes a configuration, or compares it with the one that is there."""
  if not path.exists():
    write_json(path, config)
    return
  there = read_json(path)
  if there != config:
    raise errors.ResultsError(
        f'folder {path.parent} belongs to another configuration:'
        f' {difference(there, config)}; name another folder'
    )


def difference(there: Any, here: Any, key_path: str = '') -> str:
  """Returns the first path at which two trees of JSON differ, and how."""
  if isinstance(there, dict) and isinstance(here, dict):
    for key in [*there, *(key for key in here if key not in there)]:
      if there.get(key) != here.get(key):
        inner = f'{key_path}.{key}' if key_path else key
        return difference(there.get(key), here.get(key), inner)
  return f'{key_path} is {there!r:.60} there, {here!r:.60} here'


def _digest(path: pathlib.Path) -> str:
  with explained(path), open(path, 'rb') as file:
    return hashlib.file_digest(file, 'sha256').hexdigest()


def _sync_folder(path: pathlib.Path) -> None:
  """Makes the names in a folder survive a loss of power."""
  descriptor = os.open(path, os.O_RDONLY)
  try:
    os.fsync(descriptor)
  finally:
    os.close(descriptor)

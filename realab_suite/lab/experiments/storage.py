"""Files and folders of runs, with locks and atomic writes.

A process may be killed at any time. Files are not synchronised with the disk,
so a power failure may damage them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
import errno
import fcntl
import hashlib
import json
import os
import pathlib
from typing import Any, Final, final

from realab_suite import archive
from realab_suite import errors
from realab_suite import sources

CODE: Final = 'code'
"""Key of the digest of the sources among versions."""

CONFIG = 'config.json'
DONE = 'done.json'
CHECKPOINT = 'checkpoint.ckpt'
FILM: Final = 'film.mp4'
"""Film in the folder of a demonstration."""
FILES: Final = 'files'
"""Key of the imprints of the files of finished results."""
NO_IMPRINTS: Final = (
    'results without digests, as former versions wrote them: rows that were'
    ' lost or edited since then are not noticed'
)
_LOCK = 'lock'
RESTART: Final = (
    '; remove this file, then the same command begins the run again'
)
"""Advice on a checkpoint that does not fit."""


@contextlib.contextmanager
def explained(path: str | os.PathLike[str]) -> Iterator[None]:
  """Turns an `OSError` about a file into an error of one line.

  Raises:
    ResultsError: Instead of an `OSError`.
  """
  try:
    yield
  except OSError as error:
    advice = ''
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
      advice = (
          '; complete results are kept: free some space, then run the same'
          ' command again'
      )
    raise errors.ResultsError(
        f'{os.fspath(path)}: {error.strerror or error}{advice}'
    ) from error


@contextlib.contextmanager
def fitting(path: str | os.PathLike[str]) -> Iterator[None]:
  """Turns errors about contents of another form into an error of one line.

  Raises:
    ResultsError: Instead of whatever a reader of the file raises.
  """
  try:
    with explained(path):
      yield
  except errors.RealabError:
    raise
  except Exception as error:
    problem = ' '.join(f'{type(error).__name__}: {error}'.split())
    raise errors.ResultsError(
        f'{os.fspath(path)}: damaged, or of another kind: {problem:.200}'
    ) from error


def new_folder(output: str) -> pathlib.Path:
  """Creates a folder for results, or accepts an empty one.

  Raises:
    ResultsError: If the folder is not empty or cannot be created.
  """
  folder = pathlib.Path(output).expanduser()
  with explained(folder):
    folder.mkdir(parents=True, exist_ok=True)
    is_empty = not any(folder.iterdir())
  if not is_empty:
    raise errors.ResultsError(
        f'folder {output} is not empty, and results are never overwritten; name'
        ' another folder'
    )
  return folder


def check_access(folder: pathlib.Path, *, is_written: bool = True) -> None:
  """Checks that this user may use the folder of a sweep, which may be shared.

  Files of a member whose umask is 077 are for no one else, and a job would meet
  some of them only after its work. Folders of finished jobs are only read.

  Args:
    folder: The folder; it may be missing if something is written to it.
    is_written: False if nothing is written to it.

  Raises:
    ResultsError: If something in it cannot be read, or not be written to, or
      if it is only read and is no folder.
  """

  def check(path: pathlib.Path, mode: int, what: str) -> None:
    # A job that is running may have removed a file of its own.
    if not os.access(path, mode) and path.exists():
      raise errors.ResultsError(
          f'{path}: cannot be {what} by this user; its owner can permit it to'
          f' the group: chmod -R g+rwX {folder}'
      )

  with explained(folder):
    if not (is_written or folder.is_dir()):
      what = 'a file' if folder.exists() else 'there is no such folder'
      name = str(folder).replace('\0', r'\0')
      raise errors.ResultsError(f'{name}: {what}; must be a folder of results')
    check(folder, os.R_OK | os.X_OK, 'read')
    inside = folder.iterdir() if folder.exists() else []
    # Links lead elsewhere, so jobs refuse them.
    inside = [path for path in inside if not path.is_symlink()]
    for place in filter(pathlib.Path.is_dir, [folder, *inside]):
      check(place, os.R_OK | os.X_OK, 'read')
      is_open = is_written and not (place / DONE).exists()
      if is_open:
        check(place, os.W_OK, 'written to')
      for path in filter(pathlib.Path.is_file, place.iterdir()):
        check(path, os.R_OK, 'read')
        if is_open and path.name.endswith((_LOCK, '.log')):
          check(path, os.W_OK, 'written to')


@contextlib.contextmanager
def locked(folder: pathlib.Path) -> Iterator[None]:
  """Locks a folder, and creates it if it does not exist.

  If the process is killed, the operating system releases the lock.

  Raises:
    InUseError: If another process holds the lock.
    ResultsError: If the folder cannot be written to.
  """
  path = folder / _LOCK
  with contextlib.ExitStack() as stack:
    with explained(path):
      folder.mkdir(parents=True, exist_ok=True)
      descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
      stack.callback(os.close, descriptor)
      try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
      except BlockingIOError as error:
        holder = os.pread(descriptor, 20, 0).decode(errors='replace').strip()
        raise errors.InUseError(
            f'folder {folder} is being written to by process'
            f' {holder or "(unknown)"}; wait until it ends, or stop it'
        ) from error
      os.truncate(descriptor, 0)
      os.write(descriptor, f'{os.getpid()}\n'.encode())
    yield


def write_whole(path: pathlib.Path, data: bytes) -> None:
  """Writes a file atomically.

  Raises:
    ResultsError: If it cannot be written. The old contents are kept.
  """
  partial = path.with_name(f'{path.name}.partial')
  with explained(path):
    try:
      with open(partial, 'wb') as file:
        file.write(data)
      os.replace(partial, path)
    except OSError:
      with contextlib.suppress(OSError):
        partial.unlink()
      raise


def write_json(path: pathlib.Path, content: Any) -> None:
  """Writes a JSON file atomically."""
  write_whole(path, (json.dumps(content, indent=2) + '\n').encode())


def read_json(path: pathlib.Path) -> Any:
  """Returns the contents of a JSON file.

  Raises:
    ResultsError: If it cannot be read or is not JSON.
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
  """Writes an archive atomically."""
  write_whole(path, archive.Archive(header, contents).to_bytes())


def read_archive(
    path: pathlib.Path, header: Mapping[str, Any], advice: str = ''
) -> Any:
  """Returns the contents of an archive.

  Args:
    path: Path of the archive.
    header: Header that the archive must have.
    advice: Advice to add to the message if the archive is refused.

  Raises:
    ResultsError: If it cannot be read, is damaged or has another header. The
      message contains the contents of the file and the expected ones.
  """
  with explained(path):
    data = path.read_bytes()
  with naming(path, advice):
    expected = repr(archive.name_of(header))
    return archive.Archive.from_bytes(data, expected).contents_for(header)


@contextlib.contextmanager
def naming(path: pathlib.Path, advice: str = '') -> Iterator[None]:
  """Adds the name of a file, and advice, to errors about state that is unfit.

  Raises:
    ResultsError: Instead of a `StateLayoutError`.
  """
  try:
    yield
  except errors.StateLayoutError as error:
    raise errors.ResultsError(f'{path}: {error}{advice}') from error


def check_codes(
    where: object, codes: Iterable[str | None], is_accepted: bool
) -> None:
  """Checks that results are of one code, which is that of `sources`.

  Args:
    where: Place of the results.
    codes: Codes of the results; `None` where it is unknown.
    is_accepted: True if the user accepts results of different code.

  Raises:
    ResultsError: If there are several codes, which are not accepted.
  """
  names = sorted({code or 'unknown' for code in codes})
  if len(names) > 1 and not is_accepted:
    here = sources.digest()
    raise errors.ResultsError(
        f'{where}: would mix results of code {" and ".join(names)} (here:'
        f' {here}, of {sources.FOLDER}); name another folder, or accept it with'
        ' --accept_other_code'
    )


def digests_of_files(data: Any) -> dict[str, str]:
  """Returns digests of the files that plain data names, by their paths."""
  if isinstance(data, str):
    if not (os.path.splitext(data)[1] and os.path.isfile(data)):
      return {}
    with explained(data), open(data, 'rb') as file:
      return {data: hashlib.file_digest(file, 'sha256').hexdigest()[:16]}
  parts = data.values() if isinstance(data, Mapping) else data
  if not isinstance(parts, Iterable):
    return {}
  return {k: v for part in parts for k, v in digests_of_files(part).items()}


def begin(folder: pathlib.Path, config: Mapping[str, Any]) -> None:
  """Writes the configuration of a run into its folder, unless there is one."""
  if not (folder / CONFIG).exists():
    write_json(folder / CONFIG, config)


def finish(
    folder: pathlib.Path, facts: Mapping[str, Any], names: Iterable[str] = ()
) -> None:
  """Marks a run as finished, records facts, and removes its checkpoint.

  Args:
    folder: Folder of the run.
    facts: The facts.
    names: Names of the files of lines whose imprints are recorded.
  """
  written = {name: imprint(folder / name) for name in names}
  write_json(folder / DONE, {**facts, FILES: written})
  checkpoint = folder / CHECKPOINT
  with explained(checkpoint):
    checkpoint.unlink(missing_ok=True)


def finished(folder: pathlib.Path, names: Iterable[str]) -> dict[str, Any]:
  """Returns the facts of a finished run, or nothing if it has not finished.

  Args:
    folder: Folder of the run.
    names: Names of its files of lines.

  Raises:
    ResultsError: If a file is not as the run has written it.
  """
  path = folder / DONE
  if not path.exists():
    return {}
  facts = read_json(path)
  with fitting(path):
    written = {FILES: None, **facts}[FILES]
    for name in names if written is not None else ():
      check_imprint(folder / name, written.get(name), imprint(folder / name))
  return {FILES: None, **facts}


def imprint(
    path: pathlib.Path, num_records: int | None = None
) -> dict[str, Any] | None:
  """Returns the number of records and the SHA-256 of a file, if it exists.

  Args:
    path: Path of the file.
    num_records: The number; `None` if the file has one in each line.
  """
  if not path.exists():
    return None
  with explained(path):
    data = path.read_bytes()
  if num_records is None:
    num_records = data.count(b'\n')
  digest = hashlib.sha256(data).hexdigest()
  return {'records': num_records, 'sha256': digest}


def check_imprint(path: pathlib.Path, written: Any, found: Any) -> None:
  """Refuses a file whose imprint is not the one that was written with it."""
  if written != found:
    raise errors.ResultsError(
        f'{path}: has {found or "no file"}; must have'
        f' {written or "no file"!s:.200}, as it was written; restore it, or'
        ' remove the folder and make it again'
    )


@final
class JsonLines:
  """A file of JSON lines, which can be cut back to a checkpoint."""

  def __init__(self, path: pathlib.Path, size: int | None = None) -> None:
    """Opens or creates the file.

    Args:
      path: Path of the file.
      size: Size in bytes at the checkpoint. Later lines are removed. `None`
        keeps all complete lines.

    Raises:
      ResultsError: If it cannot be opened, or is shorter than at the
        checkpoint.
    """
    self._path = path
    with explained(path):
      data = path.read_bytes() if path.exists() else b''
      if size is None:
        size = data.rfind(b'\n') + 1
      if len(data) < size:
        raise errors.ResultsError(
            f'{path}: has {len(data)} bytes; must have the {size} of the'
            f' checkpoint; remove {path.parent} to run it again'
        )
      self._file = open(path, 'ab', buffering=0)
      self._file.truncate(size)

  def append(self, records: Sequence[Mapping[str, Any]]) -> None:
    """Adds a line for each record.

    Raises:
      ResultsError: If the disk is full. The next run removes an incomplete
        line.
    """
    lines = (json.dumps(record, allow_nan=False) + '\n' for record in records)
    self.write(''.join(lines).encode())

  def write(self, lines: bytes) -> None:
    """Adds complete lines; see `append`."""
    with explained(self._path):
      while lines:
        lines = lines[self._file.write(lines) :]

  @property
  def size(self) -> int:
    """Size in bytes."""
    return os.fstat(self._file.fileno()).st_size

  def close(self) -> None:
    """Closes the file."""
    self._file.close()


def difference(there: Any, here: Any, key_path: str = '') -> str:
  """Describes the first difference between two trees of JSON."""
  if isinstance(there, dict) and isinstance(here, dict):
    for key in [*there, *(key for key in here if key not in there)]:
      if there.get(key) != here.get(key):
        inner = f'{key_path}.{key}' if key_path else key
        return difference(there.get(key), here.get(key), inner)
  return f'{key_path} is {there!r:.60} there, {here!r:.60} here'

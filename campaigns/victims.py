"""What crash campaigns do to runs: called in the children of a `Zygote`.

The runs are small and real but for their learner, which is
`tests.experiments.fake_learner`: it learns nothing, and forgets nothing.
"""

from collections.abc import Callable, Sequence
import contextlib
import ctypes
import functools
import io
import os
import pathlib
import resource
import shutil
import signal
import sys
from typing import Any, final

from absl import flags

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.experiments import engines
from realab_suite.experiments import storage
from realab_suite.experiments import training
from realab_suite.launchers import program
from realab_suite.launchers import sweep
from realab_suite.launchers import train
from tests import patience
from tests.experiments import fake_learner

_RUN = 'reward'
_SEED = 3
EXPERIMENT = {
    'schema': 1,
    'name': 'victim',
    'task': 'unlock_door.near',
    'max_steps': 5,
    'runs': {
        _RUN: {
            'design': 'instantaneous_reward',
            'overrides': ['dof=planar'],
        },
    },
    'seeds': [_SEED],
    'training': {
        'num_envs': 2,
        'steps': 48,
        'checkpoint_every': 16,
        'curve_every': 8,
    },
    'evaluation': {'episodes': 2},
}
NAMES = (
    storage.CONFIG,
    storage.DONE,
    training.EPISODES,
    training.TRACE,
    training.CURVE,
    training.TRAINING_EPISODES,
    training.LEARNER,
)
KEPT = 'kept'
# How a process may die in the middle of an operation on a file.
KILLED = 'killed'  # Before it.
TORN = 'torn'  # Half way through it, if it is a write.
POWER = 'power'  # Before it, and what was not synchronised is gone, too.
NAMES_FIRST = (
    'names'  # As above, but new names were on the disk before all else.
)
WAYS = (KILLED, TORN, POWER, NAMES_FIRST)


def run_training(
    experiment: str,
    output: str,
    *,
    die_at: int = 0,
    way: str = KILLED,
    count: str | None = None,
    limit: int | None = None,
    accident: str | None = None,
    bug: str | None = None,
) -> None:
  """Does the run as its command line does, and never returns.

  Args:
    experiment: The file of the experiment.
    output: The folder of results.
    die_at: The number of the operation on files to die at; 0 for none.
    way: How to die.
    count: A file to write the number of operations to.
    limit: No file may grow longer than so many bytes.
    accident: What happens in the middle of training, a key of `ACCIDENTS`.
    bug: What is planted, a key of `BUGS`, to see that a campaign finds it.
  """
  _keep_last_checkpoints()
  if bug is not None:
    BUGS[bug]()
  training.make_learner = functools.partial(_make, accident, output)
  shim = _Shim(die_at, way)
  shim.install()
  _obey_permissions()
  if limit is not None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
  sys.argv = ['train', f'--experiment={experiment}', f'--run={_RUN}',
              f'--seed={_SEED}', f'--output={output}']  # fmt: skip
  try:
    program.start(train.main)
  finally:
    if count is not None:
      pathlib.Path(count).write_text(str(shim.num_done))


def write_rows(
    path: str, acknowledged: str, rows: Sequence[str], die_at: int, way: str
) -> None:
  """Writes rows, and says of each when it is written.

  Args:
    path: The file of rows.
    acknowledged: The file to say so in, a byte per row.
    rows: The rows, as JSON.
    die_at: The number of the operation on files to die at.
    way: How to die.
  """
  parsed = [results.EpisodeRow.model_validate_json(row) for row in rows]
  _Shim(die_at, way).install()
  said = os.open(acknowledged, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
  with results.RowWriter(path) as writer:
    for row in parsed:
      writer.write(row)
      os.write(said, b'.')


def launch(
    experiment: str,
    output: str,
    workers: int,
    finished: str,
    bug: str | None = None,
    held: str | None = None,
    release: str | None = None,
) -> None:
  """Does the whole sweep, as its command line does, and never returns.

  Args:
    experiment: The file of the experiment.
    output: The folder of results.
    workers: How many jobs there are at a time.
    finished: The file to add the name of each job to that is over.
    bug: What is planted, a key of `BUGS`.
    held: The folder of a job that ends when there is the file `release`.
    release: The file.
  """
  if bug is not None:
    BUGS[bug]()
  _tell_of_the_finished(finished)
  if held is not None:
    _hold(held, str(release))
  engines.ENGINES['local'] = _Forks
  sys.argv = ['sweep', f'--experiment={experiment}', f'--output={output}',
              f'--workers={workers}']  # fmt: skip
  program.start(sweep.main)


# ---- Planted bugs ------------------------------------------------------------


def _write_in_place(path: pathlib.Path, data: bytes) -> None:
  with storage.open(path, 'wb') as file:
    file.write(data)


def _write_without_fsync(path: pathlib.Path, data: bytes) -> None:
  partial = path.with_name(f'{path.name}.partial')
  _write_in_place(partial, data)
  os.replace(partial, path)


def _keep_all_lines() -> None:
  begin = storage.JsonLines.__init__
  storage.JsonLines.__init__ = lambda self, path, mark=None: begin(self, path)


def _swallow_errors() -> None:
  append = storage.JsonLines.append

  def append_if_possible(self: Any, records: Any) -> None:
    with contextlib.suppress(errors.ResultsError):
      append(self, records)

  storage.JsonLines.append = append_if_possible


def _forget_a_step() -> None:
  set_state = fake_learner.FakeLearner.set_state

  def forgetful(self: Any, state: Any) -> None:
    set_state(self, {**state, 'num_steps': state['num_steps'] - 1})

  fake_learner.FakeLearner.set_state = forgetful


BUGS: dict[str, Callable[[], None]] = {
    'files are written in place': lambda: setattr(
        storage, 'write_whole', _write_in_place
    ),
    'nothing is synchronised': lambda: setattr(
        storage, 'write_whole', _write_without_fsync
    ),
    'lines behind the checkpoint stay': _keep_all_lines,
    'the learner forgets a step': _forget_a_step,
    'errors are swallowed': _swallow_errors,
    'locks hold nobody off': lambda: setattr(
        storage, 'lock', lambda folder: os.open(os.devnull, os.O_RDONLY)
    ),
}


# ---- Accidents ---------------------------------------------------------------


def _fill(folder: pathlib.Path, name: str) -> None:
  """Makes the disk full for a file that this process has open."""
  path = str(folder / name)
  full = os.open('/dev/full', os.O_WRONLY)
  for number in os.listdir('/proc/self/fd'):
    try:
      if os.readlink(f'/proc/self/fd/{number}') == path:
        os.dup2(full, int(number))
    except FileNotFoundError:
      continue  # The descriptor of the listing itself.
  os.close(full)


# What happens to the folder of a run that has one checkpoint at least.
ACCIDENTS: dict[str, Callable[[pathlib.Path], Any]] = {
    'curve is full': lambda folder: _fill(folder, training.CURVE),
    'episodes are full': lambda folder: _fill(
        folder, training.TRAINING_EPISODES
    ),
    'timing is full': lambda folder: _fill(folder, training.TIMING),
    'folder is read only': lambda folder: folder.chmod(0o500),
    'checkpoints are read only': lambda folder: (folder / 'checkpoints').chmod(
        0o500
    ),
    'folder is removed': shutil.rmtree,
}
_ACCIDENT_STEP = 9  # Of 24; there is a checkpoint after every eighth.


def _make(accident: str | None, output: str, job: Any, batch: Any) -> Any:
  """Stands in for `training.make_learner`."""
  learner = fake_learner.make(job, batch)

  def on_step(step: int) -> None:
    if accident is not None and step == _ACCIDENT_STEP:
      ACCIDENTS[accident](pathlib.Path(output) / job.folder())

  learner.on_step = on_step
  return learner


def _obey_permissions() -> None:
  """Gives up what lets root write wherever it likes."""
  header = (ctypes.c_uint32 * 2)(0x20080522, 0)
  nothing = (ctypes.c_uint32 * 6)()
  if ctypes.CDLL(None).capset(header, nothing):
    raise OSError('capset')


def _hold(folder: str, release: str) -> None:
  """Lets one job not end before there is a file, or its launcher is killed."""
  finish = storage.RunFolder.finish
  launcher = os.getpid()

  def wait_and_finish(self: Any, *arguments: Any) -> None:
    if self.path.name == folder:
      patience.until(
          lambda: os.path.exists(release) or os.getppid() != launcher
      )
      if not os.path.exists(release):
        os._exit(1)
    finish(self, *arguments)

  storage.RunFolder.finish = wait_and_finish


def _tell_of_the_finished(path: str) -> None:
  """Adds a line to a file whenever a run has done its work."""
  finish = storage.RunFolder.finish
  file = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600)

  def tell_and_finish(self: Any, *arguments: Any) -> None:
    finish(self, *arguments)
    os.write(file, f'{self.path.name}\n'.encode())

  storage.RunFolder.finish = tell_and_finish


def _keep_last_checkpoints() -> None:
  """Copies the checkpoints aside before a run that is over removes them."""
  finish = storage.RunFolder.finish

  def finish_with_a_copy(self: Any, *arguments: Any) -> None:
    kept = self.path / KEPT
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(self.path / 'checkpoints', kept)
    finish(self, *arguments)

  storage.RunFolder.finish = finish_with_a_copy


# ---- Operations on files -----------------------------------------------------


@final
class _Shim:
  """Counts what `storage` and `results` do to files, and ends the process.

  It also knows what a disk that loses its power would have: of each file what
  was there at its last `fsync`, and of each name what it meant when its folder
  was synchronised. (A new name of a file that was synchronised itself is taken
  to be on the disk, as with ext4, XFS and btrfs.)
  """

  def __init__(self, die_at: int, way: str) -> None:
    self.num_done = 0
    self._die_at = die_at
    self._way = way
    self._safe_sizes: dict[str, int] = {}
    self._renames: list[tuple[str, str, bytes | None]] = []
    self._write = io.FileIO.write
    self._originals = (os.fsync, os.replace, pathlib.Path.unlink)

  def install(self) -> None:
    """Puts itself between this package and the operating system."""
    shim, (fsync, replace, unlink) = self, self._originals

    class File(io.FileIO):
      """A file whose writes are counted."""

      def write(self, data: Any) -> int:
        shim.reach(self, bytes(data))
        return super().write(data)

      def truncate(self, size: int | None = None) -> int:
        shim.reach()
        return super().truncate(size)

    def open_counted(path: Any, mode: str = 'r', **options: Any) -> Any:
      if mode == 'rb':
        return open(path, mode)
      raw = File(os.fspath(path), mode.replace('b', ''))
      shim.opened(raw)
      if options.get('buffering') == 0:
        return raw
      return io.BufferedWriter(raw)

    def counted_fsync(descriptor: int) -> None:
      shim.reach()
      fsync(descriptor)
      shim.synchronised(os.readlink(f'/proc/self/fd/{descriptor}'))

    def counted_replace(source: Any, target: Any) -> None:
      shim.reach()
      shim.renamed(str(source), str(target))
      replace(source, target)

    def counted_unlink(path: Any, **options: Any) -> None:
      shim.reach()
      unlink(path, **options)

    storage.open = results.open = open_counted
    os.fsync, os.replace = counted_fsync, counted_replace
    pathlib.Path.unlink = counted_unlink

  def opened(self, file: Any) -> None:
    """Remembers that what is in a file by now is on the disk."""
    path = os.path.realpath(file.name)
    size = os.fstat(file.fileno()).st_size
    self._safe_sizes[path] = min(size, self._safe_sizes.get(path, size))

  def synchronised(self, path: str) -> None:
    """Remembers that a file, or the names in a folder, are on the disk."""
    if os.path.isdir(path):
      self._renames = [
          one for one in self._renames if os.path.dirname(one[1]) != path
      ]
    else:
      self._safe_sizes[path] = os.path.getsize(path)

  def renamed(self, source: str, target: str) -> None:
    """Remembers what a name meant before it is given to another file."""
    old = None
    if os.path.exists(target):
      old = pathlib.Path(target).read_bytes()
    self._renames.append((source, target, old))
    self._safe_sizes[target] = self._safe_sizes.pop(source, 0)

  def reach(self, file: Any = None, data: bytes = b'') -> None:
    """Counts an operation, and ends the process at the last one."""
    self.num_done += 1
    if self.num_done != self._die_at:
      return
    if self._way == TORN and file is not None:
      self._write(file, data[: len(data) // 2])
    if self._way in (POWER, NAMES_FIRST):
      self._lose_power()
    os.kill(os.getpid(), signal.SIGKILL)

  def _lose_power(self) -> None:
    _, replace, _ = self._originals
    for path, size in self._safe_sizes.items():
      if os.path.isfile(path) and os.path.getsize(path) > size:
        os.truncate(path, size)
    if self._way == NAMES_FIRST:
      return
    for source, target, old in reversed(self._renames):
      replace(target, source)
      if old is not None:
        pathlib.Path(target).write_bytes(old)


# ---- Sweeps ------------------------------------------------------------------


@final
class _Forks(engines.Engine):
  """Runs jobs in children of the launcher, which need no interpreter each."""

  def __init__(self, workers: int) -> None:
    self._workers = workers

  @property
  def capacity(self) -> int:
    return self._workers

  def start(self, command: Sequence[str], log: pathlib.Path) -> int:
    pid = os.fork()
    if pid:
      return pid
    _be_a_job(command, log)
    raise AssertionError('a job never returns')

  def poll(self, task: int) -> int | None:
    pid, status = os.waitpid(task, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if pid else None

  def stop(self, tasks: Sequence[int]) -> None:
    for task in tasks:
      os.kill(task, signal.SIGTERM)
      os.waitpid(task, 0)

  def arguments(self) -> list[str]:
    return [f'--parent={os.getpid()}']


def _let_go_of_locks() -> None:
  """Closes what a new interpreter would not have inherited."""
  for number in os.listdir('/proc/self/fd'):
    with contextlib.suppress(OSError):
      if os.readlink(f'/proc/self/fd/{number}').endswith('/lock'):
        os.close(int(number))


def _be_a_job(command: Sequence[str], log: pathlib.Path) -> None:
  """Does what the command line of a job says in this process, and ends it."""
  os.setsid()
  _let_go_of_locks()
  file = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o644)
  os.dup2(file, 1)
  os.dup2(file, 2)
  training.make_learner = fake_learner.make
  sys.argv = ['train', *(word for word in command if word.startswith('--'))]
  status: Any = 1
  try:
    flags.FLAGS.unparse_flags()
    program.start(train.main)
  except SystemExit as ended:
    status = ended.code or 0
  finally:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)

"""Engines that run the jobs of a sweep, each in a separate process."""

import abc
from collections.abc import Callable, Sequence
import contextlib
import importlib
import os
import pathlib
import signal
import subprocess
import sys
from typing import Any, final

from realab_suite import errors
from realab_suite.lab.experiments import requirements

# Time that a process has for ending after SIGTERM, in seconds.
_PATIENCE = 10.0
# Time limit of a Slurm job; the default of submitit is five minutes.
_MAX_MINUTES = 24 * 60


class Engine(abc.ABC):
  """Runs commands as tasks.

  Attributes:
    capacity: Maximum number of tasks at a time.
  """

  capacity: int = sys.maxsize

  @abc.abstractmethod
  def start(self, command: Sequence[str], log: pathlib.Path) -> Any:
    """Starts a command, and appends its output to a file.

    Args:
      command: Command that takes the flag `--parent`: the process whose end
        also ends the command.
      log: File for its output.

    Returns:
      The task, an argument of `poll` and `stop`.
    """

  @abc.abstractmethod
  def poll(self, task: Any) -> int | None:
    """Returns the exit status of a task, or `None` while it is running.

    The status is negative if a signal ended the command.

    Raises:
      ResultsError: If the worker that ran the command was lost.
    """

  @abc.abstractmethod
  def stop(self, tasks: Sequence[Any]) -> None:
    """Ends tasks."""


@final
class Local(Engine):
  """Parallel processes on this machine."""

  def __init__(self, workers: int) -> None:
    """Makes an engine for this number of parallel processes."""
    self.capacity = workers

  def start(self, command: Sequence[str], log: pathlib.Path) -> Any:
    with open(log, 'ab') as file:
      # In a new session, only `stop` ends the process, not the terminal.
      return subprocess.Popen(
          [*command, f'--parent={os.getpid()}'],
          stdin=subprocess.DEVNULL,
          stdout=file,
          stderr=subprocess.STDOUT,
          start_new_session=True,
      )

  def poll(self, task: Any) -> int | None:
    status = task.poll()
    return None if status is None else int(status)

  def stop(self, tasks: Sequence[Any]) -> None:
    for task in tasks:
      task.send_signal(signal.SIGTERM)
    for task in tasks:
      try:
        task.wait(_PATIENCE)
      except subprocess.TimeoutExpired:
        task.kill()
        task.wait()


@final
class Ray(Engine):
  """Tasks of a Ray cluster whose machines share the file system."""

  def __init__(self, workers: int) -> None:
    """Connects to the cluster that RAY_ADDRESS names, or starts one here."""
    del workers  # Ray determines the number of processors.
    self._ray = _import('ray')
    with _errors_in_one_line('ray'):
      self._ray.init(ignore_reinit_error=True, log_to_driver=False)
      self._execute = self._ray.remote(num_cpus=1, max_retries=0)(execute)

  def start(self, command: Sequence[str], log: pathlib.Path) -> Any:
    with _errors_in_one_line('ray'):
      return self._execute.remote(
          list(command), str(log.absolute()), os.getcwd()
      )

  def poll(self, task: Any) -> int | None:
    with _errors_in_one_line('ray'):
      done, _ = self._ray.wait([task], timeout=0)
      return int(self._ray.get(done[0])) if done else None

  def stop(self, tasks: Sequence[Any]) -> None:
    for task in tasks:
      self._ray.cancel(task, force=True)


@final
class Submitit(Engine):
  """Jobs of a Slurm cluster whose machines share the file system.

  Only the accounting of Slurm tells submitit that a job ended without a result.
  """

  def __init__(self, workers: int) -> None:
    """Makes an engine. Without Slurm, submitit runs jobs on this machine."""
    del workers  # Slurm determines the number of processors.
    self._submitit = _import('submitit')

  def start(self, command: Sequence[str], log: pathlib.Path) -> Any:
    with _errors_in_one_line('submitit'):
      executor = self._submitit.AutoExecutor(folder=str(log.parent))
      executor.update_parameters(
          cpus_per_task=1, name=log.stem, timeout_min=_MAX_MINUTES
      )
      return executor.submit(
          execute, list(command), str(log.absolute()), os.getcwd()
      )

  def poll(self, task: Any) -> int | None:
    with _errors_in_one_line('submitit'):
      return int(task.result()) if task.done() else None

  def stop(self, tasks: Sequence[Any]) -> None:
    for task in tasks:
      # A job that Slurm no longer has is no error.
      task.cancel(check=False)


ENGINES: dict[str, Callable[[int], Engine]] = {
    'local': Local,
    'ray': Ray,
    'submitit': Submitit,
}


def execute(command: Sequence[str], log: str, folder: str) -> int:
  """Runs a command in a folder, and returns its exit status."""
  with open(log, 'ab') as file:
    return subprocess.run(
        [*command, f'--parent={os.getpid()}'],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=file,
        stderr=subprocess.STDOUT,
        check=False,
    ).returncode


def _import(name: str) -> Any:
  if problem := requirements.missing(name, extra='cluster'):
    raise errors.SpecError(f'--engine={name}: {problem}')
  return importlib.import_module(name)


@contextlib.contextmanager
def _errors_in_one_line(name: str) -> Any:
  """Turns any exception of an engine into an error of one line."""
  try:
    yield
  except Exception as error:
    raise errors.ResultsError(
        f'--engine={name}: {type(error).__name__}: {error!s:.200}'
    ) from error

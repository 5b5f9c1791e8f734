"""Agents that run as separate programs, and receive only an address."""

from collections.abc import Callable, Mapping
import os
import pathlib
import pwd
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from typing import Any, final

from absl import logging

from realab_suite import errors

ADDRESS_VARIABLE = 'REALAB_ADDRESS'
"""Environment variable that contains the address of an agent's world."""

# The evaluator's environment variables that an agent inherits.
_ALLOWED_VARIABLES = ('PATH', 'LANG', 'LC_ALL', 'LC_CTYPE', 'TZ')
_PATIENCE_SECONDS = 2.0
_CHUNK = 1 << 16
MAX_LOG_BYTES = 64 << 20
"""Maximum size of the log of an agent's output."""
_CUT = b'\n... further output of the agent was not recorded\n'


def owner_of(user: str) -> tuple[int, int]:
  """Returns the ids of a user and of the user's group.

  Args:
    user: Name of the user.

  Raises:
    SpecError: If the user is unknown or root, or this process is not root.
  """
  if os.geteuid() != 0:
    raise errors.SpecError(
        f'agent_user: {user!r:.80}; only root can start programs as other users'
    )
  try:
    entry = pwd.getpwnam(user)
  except KeyError as error:
    raise errors.SpecError(f'agent_user: {user!r:.80} is unknown') from error
  if entry.pw_uid == 0:
    raise errors.SpecError(
        f'agent_user: {user!r:.80} is root, which can read everything; allowed'
        ' is any other user'
    )
  return entry.pw_uid, entry.pw_gid


def environment_of(
    folder: str, address: str, inherited: Mapping[str, str]
) -> dict[str, str]:
  """Returns the environment variables of an agent.

  Args:
    folder: Path of the agent's folder.
    address: Address of its world.
    inherited: Variables of the evaluator. Only a few harmless ones are passed
      on.
  """
  passed = {k: v for k, v in inherited.items() if k in _ALLOWED_VARIABLES}
  return {
      **passed,
      'HOME': folder,
      'TMPDIR': folder,
      ADDRESS_VARIABLE: address,
  }


@final
class AgentProcess:
  """Process of an agent, which runs while its world is served.

  It inherits no file descriptors except its standard streams: an empty input,
  and a pipe for its output, which the evaluator writes to a log.
  """

  def __init__(
      self,
      command: str,
      address: str,
      log: pathlib.Path,
      *,
      folder: str | None = None,
      owner: tuple[int, int] | None = None,
      on_exit: Callable[[], None] = lambda: None,
  ) -> None:
    """Starts the command.

    Args:
      command: Program and arguments in shell syntax.
      address: Address of the agent's world.
      log: Path of the file for the agent's output.
      folder: Working directory of the agent; `None` for a new folder, which
        `stop` removes.
      owner: Ids of the agent's user and group; `None` for those of this
        process.
      on_exit: Function that another thread calls when the agent has ended.

    Raises:
      OSError: If the file of the log cannot be opened.
      SpecError: If the command cannot be started.
    """
    self._temporary = None if folder else tempfile.mkdtemp(prefix='realab-')
    file = open(log, 'wb', buffering=0)
    self._on_exit = on_exit
    home = os.path.abspath(self._temporary or str(folder))
    if self._temporary and owner is not None:
      os.chown(self._temporary, *owner)
    user, group = owner or (None, None)
    try:
      self._process = subprocess.Popen(
          shlex.split(command),
          env=environment_of(home, address, os.environ),
          cwd=home,
          stdin=subprocess.DEVNULL,
          stdout=subprocess.PIPE,
          stderr=subprocess.STDOUT,
          close_fds=True,
          start_new_session=True,
          user=user,
          group=group,
          extra_groups=None if owner is None else [],
      )
    except (OSError, ValueError, IndexError) as error:
      file.close()
      self._clean_up()
      raise errors.SpecError(
          f'agent_command: cannot start {command!r:.80}: {error}'
      ) from error
    self._log_thread = threading.Thread(
        target=_copy, args=(self._process.stdout, file), daemon=True
    )
    self._log_thread.start()
    # Children of the agent may hold its streams open after it has ended.
    threading.Thread(target=self._wait, daemon=True).start()

  def poll(self) -> int | None:
    """Returns the exit status of the agent; `None` while it is running."""
    return self._process.poll()

  def stop(self) -> None:
    """Waits briefly for the agent to end, then terminates and kills it."""
    for number in (None, signal.SIGTERM, signal.SIGKILL):
      try:
        if number is not None:
          os.killpg(self._process.pid, number)
      except ProcessLookupError:
        break
      try:
        self._process.wait(_PATIENCE_SECONDS)
      except subprocess.TimeoutExpired:
        continue
    self._process.wait()
    self._log_thread.join(_PATIENCE_SECONDS)
    self._clean_up()

  def _wait(self) -> None:
    self._process.wait()
    self._on_exit()

  def _clean_up(self) -> None:
    if self._temporary:
      shutil.rmtree(self._temporary, ignore_errors=True)


def _copy(output: Any, log: Any) -> None:
  """Writes the agent's output to the log, without ever blocking the agent."""
  left = MAX_LOG_BYTES
  with output, log:
    while data := os.read(output.fileno(), _CHUNK):
      if left <= 0:
        continue
      left -= len(data)
      try:
        log.write(data if left > 0 else data + _CUT)
      except OSError as error:
        logging.error('the log of the agent ends here: %s', error)
        left = 0

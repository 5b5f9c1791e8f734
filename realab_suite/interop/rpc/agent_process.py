"""An agent as a program of its own, which is given an address and no more."""

from collections.abc import Callable, Mapping
import os
import pwd
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from typing import IO, Any, final

from absl import logging

from realab_suite import errors

ADDRESS_VARIABLE = 'REALAB_ADDRESS'
"""What an agent finds the address of its world in."""

# All that an agent's environment has of the evaluator's.
_ALLOWED_VARIABLES = ('PATH', 'LANG', 'LC_ALL', 'LC_CTYPE', 'TZ')
_PATIENCE_SECONDS = 2.0
_CHUNK = 1 << 16
MAX_LOG_BYTES = 64 << 20
"""So much of what an agent says is written down."""
_CUT = b'\n... the agent said more, which has not been kept\n'


def owner_of(user: str) -> tuple[int, int]:
  """Returns the ids of a user and of the user's group.

  Raises:
    SpecError: If there is no such user, it is root, or this process may not be
      another one.
  """
  if os.geteuid() != 0:
    raise errors.SpecError(
        f'agent_user: {user!r:.80}; only root can start programs of other users'
    )
  try:
    entry = pwd.getpwnam(user)
  except KeyError as error:
    raise errors.SpecError(f'agent_user: {user!r:.80} is unknown') from error
  if entry.pw_uid == 0:
    raise errors.SpecError(
        f'agent_user: {user!r:.80} is root, from whom nothing can be kept;'
        ' allowed is any other user'
    )
  return entry.pw_uid, entry.pw_gid


def environment_of(
    folder: str, address: str, inherited: Mapping[str, str]
) -> dict[str, str]:
  """Returns the environment variables of an agent.

  Args:
    folder: The agent's own.
    address: Of its world.
    inherited: The evaluator's, of which few are passed on.
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
  """A command that runs as long as its world is served.

  It inherits no descriptor but those of its standard streams: nothing to read,
  and a pipe for what it says, which its evaluator writes down.
  """

  def __init__(
      self,
      command: str,
      address: str,
      log: IO[bytes],
      *,
      folder: str | None = None,
      owner: tuple[int, int] | None = None,
      on_exit: Callable[[], None] = lambda: None,
  ) -> None:
    """Starts the command.

    Args:
      command: A program and its arguments, as one would type them.
      address: Of the agent's world.
      log: Gets what the agent says; it stays the caller's to close.
      folder: Where the agent runs; `None` for a new folder, which is removed in
        the end.
      owner: The user and the group that the agent is; `None` for this one's.
      on_exit: Called when the agent has ended, by another thread.

    Raises:
      SpecError: If there is no such command.
    """
    self._temporary = None if folder else tempfile.mkdtemp(prefix='realab-')
    self._log: IO[bytes] | None = log
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
      self._clean_up()
      raise errors.SpecError(
          f'agent_command: cannot start {command!r:.80}: {error}'
      ) from error
    self._log_lock = threading.Lock()
    self._listener = threading.Thread(
        target=self._listen, args=(self._process.stdout,), daemon=True
    )
    self._listener.start()
    # What the agent has started may hold its streams open, and outlive it.
    threading.Thread(target=self._wait, daemon=True).start()

  @property
  def pid(self) -> int:
    """The number of the process, which leads a group of its own."""
    return self._process.pid

  def poll(self) -> int | None:
    """Returns the status that the agent ended with; `None` if it runs."""
    return self._process.poll()

  def stop(self) -> None:
    """Lets the agent end, and ends it if it does not, politely at first."""
    for how in (None, signal.SIGTERM, signal.SIGKILL):
      try:
        if how is not None:
          os.killpg(self._process.pid, how)
      except ProcessLookupError:
        break
      try:
        self._process.wait(_PATIENCE_SECONDS)
      except subprocess.TimeoutExpired:
        continue
    self._process.wait()
    self._listener.join(_PATIENCE_SECONDS)
    with self._log_lock:
      self._log = None
    self._clean_up()

  def _wait(self) -> None:
    self._process.wait()
    self._on_exit()

  def _listen(self, said: Any) -> None:
    """Writes down what the agent says, and never lets it wait."""
    left = MAX_LOG_BYTES
    with said:
      while data := os.read(said.fileno(), _CHUNK):
        with self._log_lock:
          if self._log is None:
            return
          if left <= 0:
            continue
          left -= len(data)
          try:
            self._log.write(data if left > 0 else data + _CUT)
            self._log.flush()
          except OSError as error:
            logging.error('the log of the agent ends here: %s', error)
            left = 0

  def _clean_up(self) -> None:
    if self._temporary:
      shutil.rmtree(self._temporary, ignore_errors=True)

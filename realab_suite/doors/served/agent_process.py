"""Agents that run as separate programs, and receive only an address."""

from collections.abc import Callable
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from typing import final

from realab_suite import errors

ADDRESS_VARIABLE = 'REALAB_ADDRESS'
"""Environment variable that contains the address of an agent's world."""

# The evaluator's environment variables that an agent inherits.
_ALLOWED_VARIABLES = ('PATH', 'LANG', 'LC_ALL', 'LC_CTYPE', 'TZ')
_PATIENCE_SECONDS = 2.0


@final
class AgentProcess:
  """Process of an agent, which runs while its world is served.

  It inherits a few harmless environment variables, and no file descriptors
  except its standard streams: an empty input, and its log. Its working
  directory is a new folder, which `stop` removes.
  """

  def __init__(
      self,
      command: str,
      address: str,
      log: pathlib.Path,
      *,
      on_exit: Callable[[], None] = lambda: None,
  ) -> None:
    """Starts the command.

    Args:
      command: Program and arguments in shell syntax.
      address: Address of the agent's world.
      log: Path of the file for the agent's output.
      on_exit: Function that another thread calls when the agent has ended.

    Raises:
      OSError: If the file of the log cannot be opened.
      SpecError: If the command cannot be started.
    """
    self._on_exit = on_exit
    self._home = home = tempfile.mkdtemp(prefix='realab-')
    added = {'HOME': home, 'TMPDIR': home, ADDRESS_VARIABLE: address}
    inherited = {k: v for k, v in os.environ.items() if k in _ALLOWED_VARIABLES}
    with open(log, 'wb') as file:
      try:
        self._process = subprocess.Popen(
            shlex.split(command),
            env={**inherited, **added},
            cwd=home,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
      except (OSError, ValueError, IndexError) as error:
        shutil.rmtree(home, ignore_errors=True)
        raise errors.SpecError(
            f'agent_command: cannot start {command!r:.80}: {error}'
        ) from error
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
    shutil.rmtree(self._home, ignore_errors=True)

  def _wait(self) -> None:
    self._process.wait()
    self._on_exit()

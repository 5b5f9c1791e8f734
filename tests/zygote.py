"""A process that imports a module once, and forks a child for every call.

A child takes milliseconds where a new interpreter takes seconds, so thousands
of them can be killed:

    with zygote.Zygote('tests.lab.experiments.crashes') as nursery:
      pid = nursery.start('run_training', output=folder, ...)
      os.kill(pid, signal.SIGKILL)
      status, said = nursery.wait(pid)

It is a new interpreter with one thread, whatever process uses it.
"""

from collections.abc import Mapping
import importlib
import json
import os
import pathlib
import subprocess
import sys
import traceback
from typing import Any, NamedTuple, NoReturn, final

_ROOT = pathlib.Path(__file__).parents[1]


@final
class Ended(NamedTuple):
  """End of a child.

  Attributes:
    status: Exit status; below zero, minus the signal that ended it.
    said: Text of its standard output and error.
  """

  status: int
  said: str


@final
class Zygote:
  """Forks children that call functions of one module."""

  def __init__(self, module: str) -> None:
    self._process = subprocess.Popen(
        [sys.executable, '-m', 'tests.zygote', module],
        cwd=_ROOT,
        env={**os.environ, 'MUJOCO_GL': 'disable', 'OMP_NUM_THREADS': '1'},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

  def __enter__(self) -> 'Zygote':
    return self

  def __exit__(self, *unused: Any) -> None:
    with self._process:
      self._process.stdin.close()

  def start(self, function: str, /, **arguments: Any) -> int:
    """Forks a child that calls a function; returns its process id."""
    return int(self._ask({'call': function, 'with': arguments}))

  def wait(self, pid: int) -> Ended:
    """Waits for the end of a child."""
    return Ended(*self._ask({'wait': pid}))

  def call(self, function: str, /, **arguments: Any) -> Ended:
    """Calls a function in a child, and waits for its end."""
    return self.wait(self.start(function, **arguments))

  def _ask(self, question: Mapping[str, Any]) -> Any:
    self._process.stdin.write(json.dumps(question) + '\n')
    self._process.stdin.flush()
    return json.loads(self._process.stdout.readline())


def _serve(module: Any) -> None:
  """Executes the commands on the standard input, one a line."""
  pipes = {}
  for line in sys.stdin:
    task = json.loads(line)
    if 'wait' in task:
      pid = task['wait']
      _, status = os.waitpid(pid, 0)
      said = _all_of(pipes.pop(pid))
      answer: Any = [os.waitstatus_to_exitcode(status), said]
    else:
      reading, writing = os.pipe()
      answer = os.fork()
      if not answer:
        _live(getattr(module, task['call']), task['with'], writing)
      os.close(writing)
      pipes[answer] = reading
    print(json.dumps(answer), flush=True)


def _all_of(pipe: int) -> str:
  """Returns the content of a pipe, which another process may hold open."""
  os.set_blocking(pipe, False)
  parts = []
  try:
    while part := os.read(pipe, 1 << 16):
      parts.append(part)
  except BlockingIOError:
    pass
  os.close(pipe)
  return b''.join(parts).decode(errors='replace')


def _live(function: Any, arguments: dict[str, Any], pipe: int) -> NoReturn:
  """Calls a function with its own streams, and ends this process."""
  for stream in (1, 2):
    os.dup2(pipe, stream)
  os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
  os.close(pipe)
  status = 1
  try:
    status = function(**arguments) or 0
  except SystemExit as ended:
    status = ended.code or 0
  except BaseException:
    traceback.print_exc()
  finally:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == '__main__':
  _serve(importlib.import_module(sys.argv[1]))

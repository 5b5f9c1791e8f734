"""Programs that run commands of the docs, in processes forked from one.

A workshop imports the package once. Its folder `bin` holds programs with the
names of `python`, `realab` and others, for a PATH. Each sends its arguments to
the workshop, which runs them as the real program would, with small budgets, or
checks them if nothing can or should be run:

    with workshop.Workshop(folder) as shop:
      shop.run('realab compare --output=results/mine', clone)
"""

import argparse
from collections.abc import Callable
import contextlib
import functools
import importlib
import inspect
import json
import os
import pathlib
import re
import runpy
import signal
import socket
import subprocess
import sys
import traceback
from typing import Any, NamedTuple, NoReturn, final

from tests import patience
from tests.docs import pages

SKIPPED = 77
_PROGRAMS = (
    'python', 'python3', 'realab', 'pip', 'make', 'git', 'jupyter', 'uv', 'uvx',
)  # fmt: skip
# What scripts may use of the system.
_TOOLS = ('cat', 'cp', 'env', 'hostname', 'mkdir', 'mktemp', 'nproc')
_CLIENT = """#!{python} -ISs
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as line:
  line.connect({address!r})
  asked = [sys.argv, os.getcwd(), dict(os.environ), os.getppid()]
  socket.send_fds(line, [b'.'], [0, 1, 2])
  with line.makefile('rw') as file:
    print(json.dumps(asked), file=file, flush=True)
    sys.exit(int(file.readline()))
"""
_FOLDERS_OF_PROGRAMS = ('benchmarks', 'campaigns', 'pictures', 'tests')
# Exit statuses that say what an audit has found.
_FINDINGS = (0, 3, 4, 5)
_LISTENS = re.compile(r'^(?:serving .* at|Open this address)')


@final
class Ended(NamedTuple):
  """What a script has done.

  Attributes:
    status: Its exit status; `SKIPPED` if the rest of it cannot run here.
    said: Its output and errors.
    commands: For each program that it has started, the command and 'run', or
      why it was checked only or not run.
  """

  status: int
  said: str
  commands: list[tuple[str, str]]


@final
class Workshop:
  """A process that runs programs for scripts."""

  def __init__(self, folder: pathlib.Path) -> None:
    self._folder = folder
    self.bin = folder / 'bin'
    self.bin.mkdir(parents=True)
    address = str(folder / 'socket')
    client = self.bin / _PROGRAMS[0]
    client.write_text(_CLIENT.format(python=sys.executable, address=address))
    client.chmod(0o700)
    for name in _PROGRAMS[1:]:
      (self.bin / name).symlink_to(client)
    (folder / 'tools').mkdir()
    for name in (*_TOOLS, 'bash'):
      found = subprocess.run(
          ['which', name], capture_output=True, text=True, check=True
      )
      (folder / 'tools' / name).symlink_to(found.stdout.strip())
    self._listener = socket.socket(socket.AF_UNIX)
    self._listener.bind(address)
    self._listener.listen(64)
    self._process = subprocess.Popen(
        [sys.executable, '-m', __name__, str(self.bin)],
        cwd=pages.ROOT,
        stdin=self._listener,
        env={
            **os.environ,
            'MUJOCO_GL': 'egl',
            'OMP_NUM_THREADS': '1',
            'JAX_COMPILATION_CACHE_DIR': str(folder / 'compiled'),
            'JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS': '0',
        },
        start_new_session=True,
    )

  def __enter__(self) -> 'Workshop':
    return self

  def __exit__(self, *unused: Any) -> None:
    # With the servers that scripts have left behind.
    os.killpg(self._process.pid, signal.SIGKILL)
    self._process.wait()
    self._listener.close()

  def run(self, script: str, folder: pathlib.Path) -> Ended:
    """Runs a script of bash up to its first failure."""
    log, output = self._folder / 'log', self._folder / 'output'
    log.write_text('')
    with open(output, 'w', encoding='utf-8') as said:
      ran = subprocess.run(
          [self._folder / 'tools' / 'bash', '-eu', '-c', script],
          cwd=folder,
          env={
              'PATH': f'{self.bin}:{self._folder / "tools"}',
              'HOME': str(self._folder),
              'TMPDIR': str(folder),
              'DOCS_LOG': str(log),
          },
          stdin=subprocess.DEVNULL,
          stdout=said,
          stderr=said,
          timeout=10 * patience.SECONDS,
          check=False,
      )
    lines = log.read_text().splitlines()
    commands = [tuple(json.loads(line)) for line in lines]
    return Ended(ran.returncode, output.read_text(errors='replace'), commands)


class _Done(Exception):
  """Ends a command that was checked, or cannot run here."""

  def __init__(self, why: str, status: int = 0) -> None:
    super().__init__(why)
    self.status = status


def _serve(folder: str) -> NoReturn:
  """Answers the clients that connect to the socket that is standard input."""
  listener = socket.socket(fileno=os.dup(0))
  _prepare(folder)
  signal.signal(signal.SIGCHLD, signal.SIG_IGN)
  while True:
    line, _ = listener.accept()
    if not os.fork():
      signal.signal(signal.SIGCHLD, signal.SIG_DFL)
      listener.close()
      _attend(line)
    line.close()


def _prepare(folder: str) -> None:
  for name in (
      'jax', 'optax', 'equinox', 'matplotlib.pyplot', 'imageio', 'av', 'grpc',
      'gymnasium', 'realab_suite.lab.agents', 'realab_suite.suite',
      'realab_suite.lab.experiments.training', 'realab_suite.reports.html_page',
      'realab_suite.doors.served.served_evaluation',
  ):  # fmt: skip
    with contextlib.suppress(ImportError):  # Packages of extras.
      importlib.import_module(name)
  from tests.docs import small

  small.install()
  # Jobs of sweeps are started with it.
  sys.executable = f'{folder}/python'


def _attend(line: socket.socket) -> NoReturn:
  """Runs the command of a client, and tells it the exit status."""
  _, fds, *_ = socket.recv_fds(line, 1, 3)
  file = line.makefile('rw')
  argv, folder, environment, parent = json.loads(file.readline())
  reading, writing = os.pipe()
  runner = os.fork()
  if not runner:
    for number, fd in enumerate(fds):
      os.dup2(fd, number)
    # Jobs of a sweep watch their parent.
    os.getppid = lambda: parent
    _live(argv, folder, environment, writing)
  os.close(writing)
  notes, how, status = b'', 'run', None
  while part := os.read(reading, 4096):
    notes += part
    if part.endswith(b'\n'):
      how = notes.decode().splitlines()[-1]
      if how.startswith('listens'):
        status = 0
        break
  if status is None:
    status = os.waitstatus_to_exitcode(os.waitpid(runner, 0)[1])
  with open(environment['DOCS_LOG'], 'a', encoding='utf-8') as log:
    name = pathlib.Path(argv[0]).name
    print(json.dumps([' '.join([name, *argv[1:]]), how]), file=log)
  with contextlib.suppress(BrokenPipeError):
    print(status, file=file, flush=True)
  os._exit(0)


def _live(
    argv: list[str], folder: str, environment: dict[str, str], notes: int
) -> NoReturn:
  """Runs a command in this process, and ends it."""
  os.chdir(folder)
  os.environ.update(environment)
  parts = filter(None, environment.get('PYTHONPATH', '').split(':'))
  sys.path[:0] = [folder, *(os.path.join(folder, part) for part in parts)]
  status: Any = 0
  try:
    _start(pathlib.Path(argv[0]).name, argv[1:], notes)
  except SystemExit as end:
    status = end.code or 0
    if isinstance(status, str):
      print(status, file=sys.stderr)
      status = 1
  except _Done as done:
    _note(notes, str(done))
    status = done.status
  except ModuleNotFoundError as error:
    traceback.print_exc()
    status = 1
    if error.name in pages.packages_of_extras():
      _note(notes, f'skipped: {error.name} is not installed')
      status = SKIPPED
  except Exception as error:
    traceback.print_exc()
    status = 1
    if 'not installed; run: ' in str(error):
      _note(notes, f'skipped: {error}')
      status = SKIPPED
  sys.stdout.flush()
  sys.stderr.flush()
  os._exit(status)


def _note(notes: int, text: str) -> None:
  os.write(notes, f'{text}\n'.encode())


def _start(program: str, arguments: list[str], notes: int) -> None:
  """Runs or checks a program."""
  if program == 'realab':
    sys.argv = [program, *arguments]
    from realab_suite.launchers import command

    _launch(command.main, notes)
  elif program in ('python', 'python3'):
    _python(arguments, notes)
  elif program == 'make':
    subprocess.run(['/usr/bin/make', '-n', *arguments], cwd=pages.ROOT,
                   stdout=subprocess.DEVNULL, check=True)  # fmt: skip
    raise _Done('checked: the target exists')
  else:
    if program == 'git' and arguments[0] == 'clone':
      pathlib.Path([*arguments, 'realab_suite'][2]).symlink_to(pages.ROOT)
    _check_files(arguments)
    raise _Done(f'checked: the files and extras that {program} is given exist')


def _python(arguments: list[str], notes: int) -> None:
  option, *rest = arguments
  if option == '-c':
    exec(rest[0], {'__name__': '__main__'})
  elif option != '-m':
    sys.argv = arguments
    sys.path.insert(0, os.path.dirname(option))
    runpy.run_path(option, run_name='__main__')
  elif rest[0] == 'venv':
    folder = pathlib.Path(rest[1], 'bin')
    folder.mkdir(parents=True)
    for path in pathlib.Path(sys.executable).parent.iterdir():
      (folder / path.name).symlink_to(path)
  elif rest[0].startswith('realab_suite.'):
    sys.argv = rest
    _launch(functools.partial(_run_main, rest[0]), notes)
  elif rest[0].split('.')[0] in _FOLDERS_OF_PROGRAMS:
    _check_module(*rest)
  else:
    _check_files(rest[1:])
    raise _Done(f'checked: the files and extras that {rest[0]} is given exist')


def _launch(main: Callable[[], Any], notes: int) -> NoReturn:
  """Runs a launcher, up to where it listens if it serves."""
  from realab_suite.lab.experiments import requirements
  from realab_suite.launchers import program
  from realab_suite.launchers import renderers

  arguments = sys.argv[:]
  problems: list[str] = []
  missing, say = requirements.missing, program.say
  why_no_window = renderers.why_no_window

  def noting_window() -> str | None:
    problem = why_no_window()
    problems.append(problem or '')
    return problem

  def noting(*names: str, **options: str) -> str | None:
    problem = missing(*names, **options)
    problems.append(problem or '')
    return problem

  def telling(text: str) -> None:
    say(text)
    if _LISTENS.match(text):
      _note(notes, 'listens')

  requirements.missing, program.say = noting, telling
  renderers.why_no_window = noting_window
  try:
    sys.exit(main())
  except SystemExit as end:
    if end.code == 2 and any(problems):
      problem = next(filter(None, problems))
      raise _Done(f'skipped: {problem}', SKIPPED) from end
    if any('audit' in word for word in arguments[:2]) and (
        end.code in _FINDINGS
    ):
      sys.exit(0)
    if '--help' in arguments and end.code == 1:  # As absl ends.
      sys.exit(0)
    raise


def _run_main(module: str) -> NoReturn:
  runpy.run_module(module, run_name='__main__', alter_sys=True)
  raise AssertionError(f'{module} has done nothing')


def _check_module(name: str, *arguments: str) -> None:
  """Imports a program of the clone, and parses its arguments.

  It runs only if it reads results: others take minutes or write into the clone.
  """
  from campaigns import figure_lines

  def bind(main: Any) -> NoReturn:
    kinds = inspect.signature(main, eval_str=True)
    bound = kinds.bind(*arguments)
    for key, value in bound.arguments.items():
      if kinds.parameters[key].kind is not inspect.Parameter.VAR_POSITIONAL:
        kinds.parameters[key].annotation(value)
    raise _Done('checked: it takes minutes; its arguments are accepted')

  def parse(parser: argparse.ArgumentParser, *unused: Any) -> NoReturn:
    _parse_args(parser, arguments)
    raise _Done('checked: it takes minutes; its arguments are accepted')

  _parse_args = argparse.ArgumentParser.parse_args
  figure_lines.run, argparse.ArgumentParser.parse_args = bind, parse
  if name.startswith('campaigns.NAME'):
    names = [path.stem for path in pages.ROOT.glob('campaigns/*_campaign.py')]
  else:
    names = [name.rpartition('.')[2]]
  package = name.partition('.')[0]
  reads = any(argument.startswith('results/') for argument in arguments)
  sys.argv = [name, *arguments]
  for stem in names:
    source = (pages.ROOT / package / f'{stem}.py').read_text()
    if reads or 'figure_lines.run(' in source or 'argparse' in source:
      runpy.run_module(f'{package}.{stem}', run_name='__main__', alter_sys=True)
    else:
      importlib.import_module(f'{package}.{stem}')
  if not reads:
    raise _Done('checked: it takes minutes; it can be imported')


def _check_files(arguments: list[str]) -> None:
  """Fails if an argument names an extra or a file that does not exist."""
  for argument in arguments:
    path, _, extras = argument.partition('[')
    for extra in filter(None, extras.rstrip(']').split(',')):
      if extra not in pages.extras():
        sys.exit(f'{argument}: the extra {extra} does not exist')
    is_file = '/' in path or re.search(r'\.(?:txt|py|ipynb)$', path)
    if is_file and not re.match('-|dist/|https?:', path) and '<' not in path:
      if not pathlib.Path(path).exists():
        sys.exit(f'{argument}: {path} does not exist')


if __name__ == '__main__':
  _serve(sys.argv[1])

"""Runs programs within this process, as far as they get without work."""

import contextlib
import io
import os
from typing import Any, NamedTuple
from unittest import mock

from absl import flags as absl_flags
from absl.testing import flagsaver

from realab_suite import sources
from realab_suite.launchers import flags
from realab_suite.launchers import program


class Ended(NamedTuple):
  """Exit status and messages of a program."""

  status: int
  stdout: str
  stderr: str


def run(module: Any, *arguments: str) -> Ended:
  """Runs the program of a launcher with arguments."""
  stdout, stderr = io.StringIO(), io.StringIO()
  with (
      flagsaver.flagsaver(),
      mock.patch.dict(os.environ),
      mock.patch.dict(absl_flags.FLAGS._flags()),
      contextlib.redirect_stdout(stdout),
      contextlib.redirect_stderr(stderr),
  ):
    _forget_other_flags(module)
    try:
      argv = program._parse(['program', *arguments])
    except SystemExit as error:
      status = error.code
    else:
      status = program._in_one_line(module.main, argv)
      # Later tests are no part of the program.
      sources.use([], [])
  return Ended(status, stdout.getvalue(), stderr.getvalue())


def _forget_other_flags(module: Any) -> None:
  """Removes shared flags that do not exist in a process of the program."""
  taken = absl_flags.FLAGS.get_key_flags_for_module(module.__name__)
  for name in {*flags._SHARED} - {flag.name for flag in taken}:
    absl_flags.FLAGS._flags().pop(name, None)


def complaint(module: Any, *arguments: str) -> str:
  """Returns the one line with which a program refuses its arguments."""
  ended = run(module, *arguments)
  assert ended.status == program.USAGE_ERROR, ended.stderr
  assert ended.stdout == ''
  [line] = ended.stderr.splitlines()
  assert line.startswith('error: ')
  return line

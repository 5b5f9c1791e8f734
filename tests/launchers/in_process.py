"""Runs programs within this process, as far as they get without work."""

import contextlib
import io
import os
from typing import Any, NamedTuple
from unittest import mock

from absl.testing import flagsaver

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
      contextlib.redirect_stdout(stdout),
      contextlib.redirect_stderr(stderr),
  ):
    try:
      argv = program._parse(['program', *arguments])
    except SystemExit as error:
      status = error.code
    else:
      status = program._in_one_line(module.main, argv)
  return Ended(status, stdout.getvalue(), stderr.getvalue())


def complaint(module: Any, *arguments: str) -> str:
  """Returns the one line with which a program refuses its arguments."""
  ended = run(module, *arguments)
  assert ended.status == program.USAGE_ERROR, ended.stderr
  assert ended.stdout == ''
  [line] = ended.stderr.splitlines()
  assert line.startswith('error: ')
  return line

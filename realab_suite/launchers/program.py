"""Entry point of programs: parses flags and reports errors in one line."""

from collections.abc import Callable, Sequence
import functools
import io
import os
import sys
from typing import Any, final

from absl import app
from absl import flags
from absl import logging
import tqdm

from realab_suite import errors

USAGE_ERROR = 2
_INTERRUPTED = 130


@final
class _Output(io.FileIO):
  """A standard stream, silent after the end of its reader, such as `head`."""

  def write(self, data: Any) -> int:
    try:
      return super().write(data)
    except BrokenPipeError:
      return memoryview(data).nbytes


def outlive_readers() -> None:
  """Lets the program continue if its standard streams have no reader."""
  for name in ('stdout', 'stderr'):
    stream = getattr(sys, name)
    if stream is None:  # The shell has closed it.
      setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))
      continue
    raw = io.BufferedWriter(_Output(stream.fileno(), 'w', closefd=False))
    form = stream.encoding, stream.errors
    setattr(sys, name, io.TextIOWrapper(raw, *form, line_buffering=True))


def say(line: str) -> None:
  """Writes a line to the standard output, above any progress bar."""
  tqdm.tqdm.write(line)


def start(main: Callable[[], int | None]) -> None:
  """Runs a program, and reports mistakes of the user in one line.

  Args:
    main: Main function, which may return an exit status other than 0.
  """
  outlive_readers()
  app.run(functools.partial(_in_one_line, main), flags_parser=_parse)


def _parse(argv: Sequence[str]) -> list[str]:
  # By default only warnings are logged, because dm_control logs details of its
  # renderer. A flag on the command line comes later and takes precedence.
  program, *rest = argv
  rest = ['--help' if one == '-h' else one for one in rest]
  try:
    return flags.FLAGS([program, f'--verbosity={logging.WARNING}', *rest])
  except SystemExit:  # absl calls it a failure to have shown the flags.
    sys.exit(0)
  except flags.Error as error:
    _print_error(str(error))
    sys.exit(USAGE_ERROR)


def _in_one_line(main: Callable[[], int | None], argv: Sequence[str]) -> int:
  try:
    if len(argv) > 1:
      raise errors.SpecError(
          f'arguments {list(argv[1:])} are not flags; flags begin with --'
      )
    return main() or 0
  except errors.RealabError as error:
    _print_error(str(error))
    return USAGE_ERROR
  except KeyboardInterrupt:
    _print_error('interrupted; results up to this point are on disk')
    return _INTERRUPTED


def _print_error(text: str) -> None:
  sys.stderr.write(f'error: {" ".join(text.split())}\n')

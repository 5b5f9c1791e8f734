"""What the command lines of this package share: flags, and one-line errors."""

from collections.abc import Callable, Sequence
import functools
import sys
from typing import Any

from absl import app
from absl import flags
from absl import logging
import tqdm

from realab_suite import errors

USAGE_ERROR = 2
LARGEST_SEED = 2**31 - 1
"""The limit of seeds on command lines; files of experiments have the same."""
_INTERRUPTED = 130

DOMAIN = flags.DEFINE_string(
    'domain', 'unlock_door', 'The world: unlock_door or collect_apples.'
)
TASK = flags.DEFINE_string(
    'task', 'standard', 'Its variation: standard, near, far or boxed.'
)
DESIGN = flags.DEFINE_string(
    'design',
    'instantaneous_reward',
    'The agent design: the name of one that ships, or the path of a YAML file.',
)
SET = flags.DEFINE_multi_string(
    'set',
    [],
    'A dotted override of the design, as in --set=registers.reward.scale=0.2;'
    ' may be repeated.',
)
MAX_STEPS = flags.DEFINE_integer(
    'max_steps', 250, 'After how many control steps an episode ends.'
)
SEED = flags.DEFINE_integer(
    'seed',
    0,
    'From which everything random follows.',
    lower_bound=0,
    upper_bound=LARGEST_SEED,
)
TARGET = flags.DEFINE_string(
    'target',
    None,
    'The register that saboteurs attack; by default the first one that holds'
    ' feedback.',
)


def say(line: str) -> None:
  """Writes a line to the standard output, past a progress bar."""
  tqdm.tqdm.write(line)


def required(flag: flags.FlagHolder[Any], why: str = '') -> Any:
  """Returns the value of a flag.

  Raises:
    SpecError: If it is not given.
  """
  if flag.value is None or flag.value == '':
    raise errors.SpecError(f'--{flag.name}: missing{why}')
  return flag.value


def start(main: Callable[[Sequence[str]], None]) -> None:
  """Runs the program; what the user got wrong is told in one line.

  Args:
    main: Takes the arguments that are no flags, after the program's name.
  """
  app.run(functools.partial(_in_one_line, main), flags_parser=_parse)


def _parse(argv: Sequence[str]) -> list[str]:
  # Warnings alone: dm_control tells at length which renderer it has found. A
  # flag of the user's comes later and wins.
  program, *rest = argv
  try:
    return flags.FLAGS([program, f'--verbosity={logging.WARNING}', *rest])
  except flags.Error as error:
    _complain(str(error))
    sys.exit(USAGE_ERROR)


def _in_one_line(
    main: Callable[[Sequence[str]], None], argv: Sequence[str]
) -> int:
  try:
    if len(argv) > 1:
      raise errors.SpecError(
          f'arguments {list(argv[1:])} are no flags; flags begin with --'
      )
    main(argv)
  except errors.RealabError as error:
    _complain(str(error))
    return USAGE_ERROR
  except KeyboardInterrupt:
    _complain('interrupted; what is on disk is complete up to here')
    return _INTERRUPTED
  return 0


def _complain(text: str) -> None:
  sys.stderr.write(f'error: {" ".join(text.split())}\n')

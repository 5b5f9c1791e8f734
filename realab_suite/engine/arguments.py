"""Checks of the numbers that worlds are loaded, multiplied and forked with."""

from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.config import messages

# More worlds have no room on one machine.
_MOST_WORLDS = 2**16
_MOST_THREADS = 1024
# Numbers in result rows have 64 bits.
_LARGEST = 2**63 - 1


def num_envs(given: Any) -> int:
  """Returns a number of worlds as an integer.

  Raises:
    SpecError: If it is not one.
  """
  return _integer('num_envs', given, 1, _MOST_WORLDS)


def num_threads(given: Any) -> int:
  """Returns a number of threads as an integer; 0 stands for all processors.

  Raises:
    SpecError: If it is not one.
  """
  return _integer('num_threads', given, 0, _MOST_THREADS)


def world(given: Any) -> int:
  """Returns the number of a world of a batch as an integer.

  Raises:
    SpecError: If it is not one.
  """
  return _integer('world', given, 0, _LARGEST)


def max_steps(given: Any) -> int | None:
  """Returns the number of control steps of an episode; `None` for no limit.

  Raises:
    SpecError: If it is neither.
  """
  if given is None:
    return None
  return _integer('max_steps', given, 1, _LARGEST, ', and None')


def flag(what: str, given: Any) -> bool:
  """Returns a truth value.

  Args:
    what: Name of the argument.
    given: Its value.

  Raises:
    SpecError: If it is not one.
  """
  if not isinstance(given, bool | np.bool_):
    raise errors.SpecError(
        f'{what}: {messages.quote(given)}; allowed are True and False'
    )
  return bool(given)


def _integer(what: str, given: Any, low: int, high: int, more: str = '') -> int:
  is_integer = isinstance(given, int | np.integer)
  if isinstance(given, bool) or not is_integer or not low <= given <= high:
    raise errors.SpecError(
        f'{what}: {messages.quote(given)}; allowed are integers from {low} to'
        f' {high}{more}'
    )
  return int(given)

"""Checks of the numbers that worlds are loaded, multiplied and forked with."""

from collections.abc import Sequence
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


def indices(given: Any, num_envs: int) -> np.ndarray:
  """Returns indices of worlds of a batch; all of them for `None`.

  Args:
    given: A sequence of indices, or `None`.
    num_envs: Number of worlds in the batch.

  Raises:
    SpecError: If one is no index in this batch, or is given twice.
  """
  if given is None:
    return np.arange(num_envs)
  if (
      not isinstance(given, Sequence | np.ndarray)
      or not len(given)
      or not all(
          isinstance(index, int | np.integer)
          and type(index) is not bool
          and 0 <= index < num_envs
          for index in given
      )
      or len(set(given)) < len(given)
  ):
    raise errors.SpecError(
        f'worlds: {messages.quote(given)}; allowed are integers from 0 to'
        f' {num_envs - 1}, each once'
    )
  return np.array(given)


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

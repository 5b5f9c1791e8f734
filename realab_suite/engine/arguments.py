"""Checks of the arguments for loading and batching worlds."""

from collections.abc import Sequence
import os
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import loading
from realab_suite.config import messages

MAX_ENVS = 2**16
"""Largest number of worlds; more do not fit into the memory of one machine."""

_MAX_THREADS = 1024


def num_envs(given: Any) -> int:
  """Returns a number of worlds as an integer.

  Raises:
    SpecError: If it is not an integer from 1 to 65,536.
  """
  return integers.check('num_envs', given, 1, MAX_ENVS)


def num_threads(given: Any) -> int:
  """Returns a number of threads; 0 stands for one for each of `processors`.

  Raises:
    SpecError: If it is not an integer from 0 to 1,024.
  """
  threads = integers.check('num_threads', given, 0, _MAX_THREADS)
  return threads or min(processors(), _MAX_THREADS)


def processors() -> int:
  """Returns the number of processors that this process may use."""
  if hasattr(os, 'sched_getaffinity'):  # macOS has no such limits.
    return len(os.sched_getaffinity(0))
  return os.cpu_count() or 1


def indices(given: Any, num_envs: int) -> np.ndarray:
  """Returns indices of worlds in a batch, `(indices,)` int.

  Args:
    given: Sequence of indices, or `None` for all worlds.
    num_envs: Number of worlds in the batch.

  Raises:
    SpecError: If an index is not in this batch or is given twice, or if there
      are none.
  """
  if given is None:
    return np.arange(num_envs)
  if (
      not isinstance(given, Sequence | np.ndarray)
      or not len(given)
      or not all(
          integers.is_integer(index) and 0 <= index < num_envs
          for index in given
      )
      or len(set(given)) < len(given)
  ):
    raise errors.SpecError(
        f'worlds: {messages.quote(given)}; must be integers from 0 to'
        f' {num_envs - 1}, each once'
    )
  return np.array(given)


def senses(given: Any) -> tuple[str, ...] | None:
  """Returns names of senses; `None` for the default senses.

  Raises:
    SpecError: If it is neither a list of different strings nor `None`.
  """
  if given is None:
    return None
  if (
      not loading.is_list(given)
      or not all(isinstance(name, str) for name in given)
      or len(set(given)) < len(given)
  ):
    raise errors.SpecError(
        f'senses: {messages.quote(given)}; must be a list of names, each'
        ' once, or None'
    )
  return tuple(given)


def camera(given: Any, mjcf_model: Any) -> str:
  """Returns the name of a camera of a model.

  Raises:
    SpecError: If the model has no such camera.
  """
  names = [one.full_identifier for one in mjcf_model.find_all('camera')]
  if given not in names:
    raise errors.SpecError(f'camera: {given!r}; must be one of {names}')
  return str(given)


def flag(name: str, given: Any) -> bool:
  """Returns a Boolean argument.

  Args:
    name: Name of the argument.
    given: Value of the argument.

  Raises:
    SpecError: If the value is not a Boolean.
  """
  if not isinstance(given, bool | np.bool_):
    raise errors.SpecError(
        f'{name}: {messages.quote(given)}; must be True or False'
    )
  return bool(given)

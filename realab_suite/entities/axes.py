"""Numbers of one world and arrays of many, in the same words.

NumPy calculates with numbers (`np.float64`) ten times as fast as with arrays
that have no axes, and what one world stores in a scalar or in one component of
a vector would be such an array.
"""

from typing import Any

import numpy as np


def component(array: np.ndarray, index: int) -> np.ndarray:
  """Returns `array[..., index]`, which in one world is a number."""
  return array[..., index][()]


def anywhere(condition: np.ndarray) -> bool:
  """Whether a condition, `(...)`, is true in any world."""
  if condition.ndim:
    return bool(np.count_nonzero(condition))
  return bool(condition)


def everywhere(condition: np.ndarray) -> bool:
  """Whether a condition, `(...)`, bool, is true in all worlds."""
  if condition.ndim:
    return bool(np.count_nonzero(condition) == condition.size)
  return bool(condition)


def choose(condition: np.ndarray, yes: Any, no: Any) -> Any:
  """Returns `yes` where a condition, `(...)`, is true, and `no` elsewhere."""
  if np.ndim(condition):
    return np.where(condition, yes, no)
  return yes if condition else no

"""Helpers for code that serves both one world and a batch of worlds.

A value of one world is a number (`np.float64`), a value of a batch is an array
`(worlds,)`. NumPy calculates with numbers ten times as fast as with arrays
without axes, so these helpers return numbers for one world.
"""

import math
from typing import Any

import numpy as np


def component(array: np.ndarray, index: int) -> np.ndarray:
  """Returns `array[..., index]`; a number if `array` has one axis."""
  return array[index] if array.ndim == 1 else array[..., index][()]


def anywhere(condition: np.ndarray) -> bool:
  """Returns True if a condition, `(...)`, is true in any world."""
  if condition.ndim:
    return bool(np.count_nonzero(condition))
  return bool(condition)


def everywhere(condition: np.ndarray) -> bool:
  """Returns True if a condition, `(...)` bool, is true in all worlds."""
  if condition.ndim:
    return bool(np.count_nonzero(condition) == condition.size)
  return bool(condition)


def is_finite(value: Any) -> Any:
  """Returns True where a value, `(...)`, is finite."""
  if isinstance(value, np.ndarray) and value.ndim:
    return np.isfinite(value)
  return math.isfinite(value)


def choose(condition: np.ndarray, yes: Any, no: Any) -> Any:
  """Returns `yes` where a condition, `(...)`, is true, and `no` elsewhere."""
  if isinstance(condition, np.ndarray) and condition.ndim:
    return np.where(condition, yes, no)
  return yes if condition else no

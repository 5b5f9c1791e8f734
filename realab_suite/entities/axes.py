"""Helpers for code that serves both one world and a batch of worlds.

A value of one world is a number (`np.float64`), a value of a batch is an array
`(worlds,)`. NumPy calculates with numbers ten times as fast as with arrays
without axes, so these helpers return numbers for one world. So does unpacking a
transpose: `x, y, z = position.T` for positions `(..., 3)`.

A mask says in which worlds something happens: `(...)` bool, or `None` for all
worlds.
"""

import math
from typing import Any

import numpy as np

Mask = np.ndarray | None


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


def both(first: Mask, second: Mask) -> Mask:
  """Returns the mask of the worlds in which two masks are true.

  The result is `None` if that is so in all worlds.
  """
  if first is None or second is None:
    mask = second if first is None else first
  else:
    mask = first & second
  return None if mask is None or everywhere(mask) else mask


def merge(where: Mask, new: Any, old: Any) -> Any:
  """Returns `new` where a mask is true, and `old` elsewhere.

  Args:
    where: The mask.
    new: Values that broadcast to the shape of `old`.
    old: Values, `(..., k)` with any number of trailing axes.
  """
  if where is None:
    return new
  mask = np.reshape(where, (*where.shape, *[1] * (np.ndim(old) - where.ndim)))
  return np.where(mask, new, old)


def assign(bound: Any, name: str, value: Any, where: Mask) -> None:
  """Writes an attribute of bound elements where a mask is true.

  Args:
    bound: A `protocols.Binding`.
    name: Name of the attribute.
    value: Values that broadcast to the shape of the attribute.
    where: The mask.
  """
  if where is not None:
    value = merge(where, value, getattr(bound, name))
  setattr(bound, name, value)

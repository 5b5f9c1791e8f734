"""Trees: tuples, lists and dicts that contain arrays and other plain values.

States of providers and snapshots are trees. The leading axis of the arrays of a
batch is the axis of worlds.
"""

from collections.abc import Callable
from typing import Any

import numpy as np


def mapped(function: Callable[[Any], Any], tree: Any) -> Any:
  """Returns a tree with a function applied to each of its values."""
  if isinstance(tree, dict):
    return {key: mapped(function, value) for key, value in tree.items()}
  if isinstance(tree, tuple | list):
    return type(tree)(mapped(function, value) for value in tree)
  return function(tree)


def taken(tree: Any, rows: np.ndarray | int) -> Any:
  """Returns a tree with the given rows of each array, in this order."""
  return mapped(lambda value: value[rows], tree)


def put(tree: Any, rows: np.ndarray, values: Any) -> Any:
  """Returns a copy of a tree with some rows of each array replaced.

  Args:
    tree: Tree of arrays; it is not changed.
    rows: Indices of the rows.
    values: Tree with the new rows, in this order.

  Raises:
    ValueError: If the trees differ in structure or in the shape of a row.
  """
  if type(tree) is not type(values):
    raise ValueError(f'{type(values)} in place of {type(tree)}')
  if isinstance(tree, dict):
    if tree.keys() != values.keys():
      raise ValueError(f'keys {sorted(values)} in place of {sorted(tree)}')
    return {key: put(value, rows, values[key]) for key, value in tree.items()}
  if isinstance(tree, tuple | list):
    pairs = zip(tree, values, strict=True)
    return type(tree)(put(value, rows, new) for value, new in pairs)
  if values.shape != (len(rows), *tree.shape[1:]):
    raise ValueError(f'shape {values.shape} in place of {tree.shape}')
  result = np.array(tree)
  result[rows] = values
  return result


def are_equal(tree: Any, other: Any) -> bool:
  """Returns True if two trees have the same structure and equal values.

  A nan is equal to a nan. Values that cannot be compared are not equal.
  """
  if type(tree) is not type(other):
    return False
  if isinstance(tree, dict):
    return tree.keys() == other.keys() and all(
        are_equal(value, other[key]) for key, value in tree.items()
    )
  if isinstance(tree, tuple | list):
    return len(tree) == len(other) and all(map(are_equal, tree, other))
  if not isinstance(tree, np.ndarray | np.generic):
    try:
      return bool(tree == other)
    except Exception:  # Objects may raise any class.
      return False
  if tree.dtype != other.dtype or tree.shape != other.shape:
    return False
  # Bytes are fast to compare. Only equal numbers of other bytes need more.
  if tree.tobytes() == other.tobytes():
    return True
  return not np.count_nonzero(_differ(tree, other))


def differing(tree: Any, other: Any) -> Any:
  """Returns the rows in which two trees of arrays differ, `(rows,)` bool.

  A nan is equal to a nan. Trees of no arrays differ nowhere: False.

  Args:
    tree: Tree of arrays with a leading axis.
    other: Tree of the same structure and shapes.
  """
  if isinstance(tree, dict):
    pairs: Any = [(value, other[key]) for key, value in tree.items()]
  elif isinstance(tree, tuple | list):
    pairs = list(zip(tree, other, strict=True))
  else:
    return _differ(tree, other).reshape(len(tree), -1).any(axis=1)
  found: Any = False
  for value, its in pairs:
    found = found | differing(value, its)
  return found


def _differ(array: Any, other: Any) -> Any:
  """Returns True where two arrays differ; a nan is equal to a nan."""
  # Only a nan differs from itself.
  return (array != other) & ((array == array) | (other == other))

"""Trees: tuples, lists and dicts that contain arrays and other plain values.

States of providers and snapshots are trees. The leading axis of the arrays of a
batch is the axis of worlds.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

# Types whose values are the same if they are equal.
_PLAIN = (bool, int, str, bytes, type(None))


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
  """Returns True if two trees have the same structure and the same values.

  Floats are the same if their bytes are: 0.0 is not -0.0, and a nan may be
  another one. Values other than numbers, texts and `None` never are.
  """
  if type(tree) is not type(other):
    return False
  if isinstance(tree, dict):
    return tree.keys() == other.keys() and all(
        are_equal(value, other[key]) for key, value in tree.items()
    )
  if isinstance(tree, tuple | list):
    return len(tree) == len(other) and all(map(are_equal, tree, other))
  if isinstance(tree, float):  # Also those of NumPy.
    return np.float64(tree).tobytes() == np.float64(other).tobytes()
  if isinstance(tree, np.ndarray | np.generic):
    return bool(
        tree.dtype == other.dtype
        and tree.shape == other.shape
        and not tree.dtype.hasobject
        and tree.tobytes() == other.tobytes()
    )
  return type(tree) in _PLAIN and bool(tree == other)


def differing(tree: Any, other: Any) -> Any:
  """Returns the rows in which two trees of arrays differ, `(rows,)` bool.

  Values are the same if their bytes are. Trees of no arrays differ nowhere:
  False.

  Args:
    tree: Tree of arrays with a leading axis.
    other: Tree of the same structure and shapes.
  """
  if isinstance(tree, dict):
    pairs: Any = [(value, other[key]) for key, value in tree.items()]
  elif isinstance(tree, tuple | list):
    pairs = list(zip(tree, other, strict=True))
  else:
    return (_rows_of_bytes(tree) != _rows_of_bytes(other)).any(axis=1)
  rows: Any = False
  for value, counterpart in pairs:
    rows = rows | differing(value, counterpart)
  return rows


def _rows_of_bytes(array: np.ndarray) -> np.ndarray:
  data = np.frombuffer(array.tobytes(), np.uint8)
  return data.reshape(len(array), array.nbytes // max(len(array), 1))

"""Helpers for queries: indices of actions from readings, and their values."""

import numpy as np


def index(reading: np.ndarray, num_actions: int) -> np.ndarray:
  """Returns the index of the action nearest to a reading, `(...)` int.

  Args:
    reading: Readings of a query register, `(...)`.
    num_actions: Number of actions.
  """
  return np.clip(np.rint(reading), 0, num_actions - 1).astype(int)


def pick(values: np.ndarray, action: np.ndarray) -> np.ndarray:
  """Returns the value of one action in each world, `(...)`.

  Args:
    values: Value of each action, `(..., actions)`.
    action: Index of the action, `(...)` int.
  """
  picked = np.take_along_axis(values, np.asarray(action)[..., np.newaxis], -1)
  return picked[..., 0]

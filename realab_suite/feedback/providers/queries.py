"""Queries: the index of an action, read off a register, and its value."""

import numpy as np


def index(reading: np.ndarray, num_actions: int) -> np.ndarray:
  """Returns the action nearest to a reading, `(...)`, int."""
  return np.clip(np.rint(reading), 0, num_actions - 1).astype(int)


def pick(values: np.ndarray, action: np.ndarray) -> np.ndarray:
  """Returns the value of an action, `(...)`, world by world.

  Args:
    values: Of every action, `(..., actions)`.
    action: The index of one, `(...)`.
  """
  picked = np.take_along_axis(values, np.asarray(action)[..., np.newaxis], -1)
  return picked[..., 0]

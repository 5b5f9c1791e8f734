"""Random keys: randomness that is passed in, one key per world and step."""

import numpy as np


def generator(key: np.ndarray) -> np.random.Generator:
  """Returns the generator that one world's key, `(2,)` uint64, stands for."""
  return np.random.Generator(np.random.Philox(key=key))


def uniform(key: np.ndarray, shape: tuple[int, ...] = ()) -> np.ndarray:
  """Returns numbers in [0, 1) that depend on each world's own key only.

  Args:
    key: uint64, shape `(..., 2)`.
    shape: How many numbers each world gets.

  Returns:
    Shape `(..., *shape)`.
  """
  flat = key.reshape(-1, 2)
  draws = np.stack([generator(one).random(shape) for one in flat])
  return draws.reshape((*key.shape[:-1], *shape))

"""Random numbers from keys: one key for each world and step."""

import numpy as np


def generator(key: np.ndarray) -> np.random.Generator:
  """Returns the generator seeded by the key of one world, `(2,)`, uint64."""
  return np.random.Generator(np.random.Philox(key=key))


def uniform(key: np.ndarray, shape: tuple[int, ...] = ()) -> np.ndarray:
  """Returns numbers in [0, 1); those of a world depend on its own key only.

  Args:
    key: Keys, `(..., 2)`, uint64.
    shape: Shape of the numbers of each world.

  Returns:
    Numbers, `(..., *shape)`.
  """
  flat = key.reshape(-1, 2)
  draws = np.stack([generator(one).random(shape) for one in flat])
  return draws.reshape((*key.shape[:-1], *shape))


def of_step(key: np.ndarray, step: int | np.ndarray) -> np.ndarray:
  """Returns the key of one control step.

  Args:
    key: Key of the episode, `(..., 2)` uint64.
    step: Number of the control step, `(...)`.

  Returns:
    The key of the step, `(..., 2)` uint64.
  """
  stepped = np.array(key)
  stepped[..., 1] += np.uint64(step)
  return stepped

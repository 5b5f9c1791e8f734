"""What an agent can remember of the readings of an episode.

A policy that sees only the present cannot return to where it was paid, and
cannot tell what it was paid for. A recollection is made of what the agent
observes anyway, its readings and its pose, and is a part of its observation.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

SENSES = ('senses/position', 'senses/heading')
"""Keys of what a recollection is made of, besides a reading."""

NUMBERS = ('sum', 'last', 'least', 'greatest', 'number', 'paid', 'x', 'y',
           'distance', 'ahead', 'left')  # fmt: skip
"""Names of its numbers.

Of the readings of this episode of which it takes notice: sum, last, least,
greatest and number; and of the place where the last positive one was read: 1 if
there is one, its coordinates, its distance from the avatar, in m, and the
cosine and the sine of its angle to the left of ahead. All are 0 before.
"""

# Size of the smallest reading of which it takes notice. Blocks that were
# touched store a little more or less than 0.
_NOTICED = 0.1
_PREFIX, _SUFFIX = 'registers/', '/recollection'


def key_of(reading: str) -> str:
  """Returns the key of the recollection of a reading.

  Args:
    reading: Key of the reading in observations.
  """
  return f'{_PREFIX}{reading.removeprefix(_PREFIX)}{_SUFFIX}'


def reading_of(key: str) -> str | None:
  """Returns the key of the reading of a recollection; `None` for other keys."""
  is_one = key.startswith(_PREFIX) and key.endswith(_SUFFIX)
  return key.removesuffix(_SUFFIX) if is_one else None


def initial(batch_shape: tuple[int, ...]) -> np.ndarray:
  """Returns the recollection before the first step, `(..., numbers)`."""
  return np.zeros((*batch_shape, len(NUMBERS)), np.float32)


def recall(
    observation: Mapping[str, Any],
    reading: str,
    is_first: np.ndarray,
    earlier: np.ndarray,
) -> np.ndarray:
  """Returns the recollection after a step, `(..., numbers)`, float32.

  Args:
    observation: Observation of the step, with the reading and `SENSES`.
    reading: Key of the reading.
    is_first: True where an episode begins, `(...)`. No action precedes its
      reading, so nothing is remembered of it.
    earlier: Recollection of the step before.
  """
  value = np.asarray(observation[reading], np.float32)
  position, heading = (np.asarray(observation[k], np.float32) for k in SENSES)
  now = np.where(np.asarray(is_first)[..., np.newaxis], np.float32(0), earlier)
  is_noticed = (np.abs(value) >= _NOTICED) & ~np.asarray(is_first)
  is_new = is_noticed & (now[..., 4] == 0)
  then = np.stack(
      [
          now[..., 0] + value,
          value,
          np.where(is_new, value, np.minimum(now[..., 2], value)),
          np.where(is_new, value, np.maximum(now[..., 3], value)),
          now[..., 4] + np.float32(1),
      ],
      axis=-1,
  )
  now[..., :5] = np.where(is_noticed[..., np.newaxis], then, now[..., :5])
  pays = (is_noticed & (value > 0))[..., np.newaxis]
  now[..., 5:6] = np.where(pays, np.float32(1), now[..., 5:6])
  now[..., 6:8] = np.where(pays, position, now[..., 6:8])
  x, y = np.moveaxis((now[..., 6:8] - position) * now[..., 5:6], -1, 0)
  cos, sin = heading[..., 0], heading[..., 1]
  distance = np.sqrt(x * x + y * y)
  now[..., 8] = distance
  # At the place itself, all directions are as good.
  at_least = np.maximum(distance, np.float32(1e-6))
  now[..., 9] = (x * cos + y * sin) / at_least
  now[..., 10] = (y * cos - x * sin) / at_least
  return now

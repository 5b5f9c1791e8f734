"""Random streams: each has a name, and none depends on another's use.

Every stream follows from (seed, world, episode, name). So world i of a batch is
the run of that world alone, and two agents meet the same initial states in
their k-th episodes, however long the episodes before were.
"""

from typing import Any
import zlib

import numpy as np

from realab_suite import errors


def as_seed(random: Any) -> int:
  """Returns the seed that a `random` argument of dm_control's stands for.

  Args:
    random: A non-negative integer, a `RandomState`, which is read from a copy,
      or `None` for a seed from the operating system.

  Raises:
    SpecError: If it is something else.
  """
  if random is None:
    return int(np.random.SeedSequence().generate_state(1)[0])
  if isinstance(random, np.random.RandomState):
    copy = np.random.RandomState()
    copy.set_state(random.get_state())
    return int(copy.randint(2**31))
  if isinstance(random, int | np.integer) and not isinstance(random, bool):
    if random >= 0:
      return int(random)
  raise errors.SpecError(
      f'random: {random!r:.80}; allowed are a non-negative integer, a'
      ' RandomState or None'
  )


def sequence(
    seed: int, world: int, episode: int, stream: str
) -> np.random.SeedSequence:
  """Returns the source of the stream called `stream`."""
  name = zlib.crc32(stream.encode())
  return np.random.SeedSequence((seed, world, episode, name))


def random_state(
    seed: int, world: int, episode: int, stream: str
) -> np.random.RandomState:
  """Returns the stream as what Composer's hooks take."""
  made = np.random.RandomState(0)
  reseed(made, seed, world, episode, stream)
  return made


def reseed(
    random_state: np.random.RandomState,
    seed: int,
    world: int,
    episode: int,
    stream: str,
) -> None:
  """Makes a `RandomState` go on as another stream.

  To make a new one for every episode takes longer than all the rest of a reset
  of one world among many.
  """
  words = sequence(seed, world, episode, stream).generate_state(8)
  random_state.seed(words)


def episode_key(seed: int, world: int, episode: int, stream: str) -> np.ndarray:
  """Returns the key of a stream of keys, `(2,)` uint64."""
  return sequence(seed, world, episode, stream).generate_state(2, np.uint64)


def step_key(key: np.ndarray, step: int | np.ndarray) -> np.ndarray:
  """Returns the key of one control step.

  Args:
    key: Of the episode, `(..., 2)`, uint64.
    step: The number of the control step, `(...)`.

  Returns:
    `(..., 2)`, uint64.
  """
  stepped = np.array(key)
  stepped[..., 1] += np.uint64(step)
  return stepped

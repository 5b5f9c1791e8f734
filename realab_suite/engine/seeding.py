"""Random streams, each with a name and independent of the use of the others.

Every stream is a function of (seed, world, episode, name). World i of a batch
therefore equals that world alone. The k-th episodes of two agents begin in the
same state, regardless of the lengths of the episodes before.

The package is public, so an agent that knows the seed can clone the world.
"""

from collections.abc import Sequence
from typing import Any
import zlib

import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages


def as_seed(random: Any) -> int:
  """Returns the seed for a `random` argument, as used in dm_control.

  Args:
    random: Non-negative integer; a `RandomState`, which is copied and not
      advanced; or `None` for a seed from the operating system.

  Raises:
    SpecError: If it is something else.
  """
  if random is None:
    return int(np.random.SeedSequence().generate_state(1)[0])
  if isinstance(random, np.random.RandomState):
    copy = np.random.RandomState()
    copy.set_state(random.get_state())
    return int(copy.randint(2**31))
  if integers.is_integer(random) and random >= 0:
    return int(random)
  raise errors.SpecError(
      f'random: {messages.quote(random)}; must be a non-negative integer, a'
      ' RandomState or None'
  )


def seeds(random: Any, num_envs: int) -> np.ndarray:
  """Returns the seed of each world or `None`, `(worlds,)`, objects.

  Args:
    random: Seed of all worlds, as in `as_seed`, or a sequence or array with the
      seed of each world, or `None` for a world without a new one.
    num_envs: Number of worlds.

  Raises:
    SpecError: If a seed is invalid, or their number is wrong.
  """
  if isinstance(random, np.ndarray) and random.ndim:
    random = random.tolist()
  if not isinstance(random, Sequence):
    random = [as_seed(random)] * num_envs
  if len(random) != num_envs:
    raise errors.SpecError(
        f'random: {len(random)} seeds; must be one seed, or {num_envs}'
        ' seeds, one for each world'
    )
  # Objects keep large seeds.
  return np.array(
      [one if one is None else as_seed(one) for one in random], object
  )


def sequence(
    seed: int, world: int, episode: int, stream: str
) -> np.random.SeedSequence:
  """Returns the seed sequence of a stream."""
  name = zlib.crc32(stream.encode())
  return np.random.SeedSequence((seed, world, episode, name))


def random_state(
    seed: int, world: int, episode: int, stream: str
) -> np.random.RandomState:
  """Returns a stream as a `RandomState`, for Composer's hooks."""
  generator = np.random.RandomState(0)
  reseed(generator, seed, world, episode, stream)
  return generator


def reseed(
    random_state: np.random.RandomState,
    seed: int,
    world: int,
    episode: int,
    stream: str,
) -> None:
  """Sets a `RandomState` to the beginning of another stream.

  In a batch, creating a new `RandomState` for each episode would take longer
  than the rest of the reset.
  """
  words = sequence(seed, world, episode, stream).generate_state(8)
  random_state.seed(words)


def episode_key(seed: int, world: int, episode: int, stream: str) -> np.ndarray:
  """Returns the key of a stream in an episode, `(2,)` uint64."""
  return sequence(seed, world, episode, stream).generate_state(2, np.uint64)

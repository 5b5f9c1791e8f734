"""Random streams, each with a name and independent of the use of the others.

Every stream is a function of (seed, world, episode, name), or of (salt, seed,
world, episode, name) for a `SaltedSeed`. World i of a batch therefore equals
that world alone. The k-th episodes of two agents begin in the same state,
regardless of the lengths of the episodes before.
"""

from collections.abc import Sequence
import hashlib
import secrets
from typing import Any, Self, final
import zlib

import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages

NUM_SALT_BYTES = 16
"""Length of a salt, in bytes."""

# Purposes of the hash, which make its results unrelated.
_FOR_STREAMS = b'realab streams'
_FOR_DIGEST = b'realab digest'


@final
class SaltedSeed(int):
  """A public seed with a secret salt, on which every random stream depends.

  The package is public, so a clone with the same seed has the same episodes.
  With a salt, the source of each stream is a keyed hash: without the salt no
  stream can be predicted, not even from the other streams.

  It is an integer, so it can be passed wherever a seed can: it prints, sorts
  and is written to result rows as the number, without the salt. Arithmetic
  returns plain integers; so does NumPy, except in arrays of objects. Snapshots
  contain the salt.

  Attributes:
    salt: Secret bytes, of length `NUM_SALT_BYTES`.
  """

  salt: bytes

  def __new__(cls, seed: int, salt: bytes) -> Self:
    """Creates a salted seed.

    Args:
      seed: Non-negative integer.
      salt: `NUM_SALT_BYTES` bytes that are hard to guess.

    Raises:
      SpecError: If the seed or the salt is invalid.
    """
    if type(salt) is not bytes or len(salt) != NUM_SALT_BYTES:
      # The message does not repeat what may be a secret.
      raise errors.SpecError(
          f'salt: a {type(salt).__name__}; allowed are {NUM_SALT_BYTES} bytes'
      )
    made = super().__new__(cls, as_seed(seed))
    made.salt = salt
    return made

  def __getnewargs__(self) -> tuple[int, bytes]:  # type: ignore[override]
    return int(self), self.salt

  @property
  def salt_digest(self) -> str:
    """Digest of the salt, which can be published."""
    digest = hashlib.blake2b(self.salt, digest_size=8, person=_FOR_DIGEST)
    return digest.hexdigest()


def new_salt() -> bytes:
  """Returns a salt from the operating system."""
  return secrets.token_bytes(NUM_SALT_BYTES)


def as_seed(random: Any) -> int:
  """Returns the seed for a `random` argument, as used in dm_control.

  Args:
    random: Non-negative integer, which may be a `SaltedSeed`; a `RandomState`,
      which is copied and not advanced; or `None` for a seed from the operating
      system.

  Raises:
    SpecError: If it is something else.
  """
  if isinstance(random, SaltedSeed):
    return random
  if random is None:
    return int(np.random.SeedSequence().generate_state(1)[0])
  if isinstance(random, np.random.RandomState):
    copy = np.random.RandomState()
    copy.set_state(random.get_state())
    return int(copy.randint(2**31))
  if integers.is_integer(random) and random >= 0:
    return int(random)
  raise errors.SpecError(
      f'random: {messages.quote(random)}; allowed are a non-negative integer, a'
      ' RandomState or None'
  )


def seeds(random: Any, num_envs: int) -> np.ndarray:
  """Returns the seed of each world, `(worlds,)`, objects.

  Args:
    random: Seed of all worlds, as in `as_seed`, or a sequence with the seed of
      each world.
    num_envs: Number of worlds.

  Raises:
    SpecError: If a seed is invalid, or their number is wrong.
  """
  if not isinstance(random, Sequence):
    random = [as_seed(random)] * num_envs
  if len(random) != num_envs:
    raise errors.SpecError(
        f'random: {len(random)} seeds; allowed are one seed, and {num_envs}'
        ' seeds, one for each world'
    )
  # Objects keep large seeds and salts.
  return np.array([as_seed(one) for one in random], object)


def sequence(
    seed: int, world: int, episode: int, stream: str
) -> np.random.SeedSequence:
  """Returns the seed sequence of a stream.

  Args:
    seed: Seed, which may be a `SaltedSeed`.
    world: Number of the world.
    episode: Number of the episode.
    stream: Name of the stream.
  """
  if isinstance(seed, SaltedSeed):
    # A seed sequence is not a one-way function. With it alone, the salt and all
    # other streams could be computed from the words of one stream.
    words = hashlib.blake2b(
        f'{seed},{world},{episode},{stream}'.encode(),
        key=seed.salt,
        person=_FOR_STREAMS,
        digest_size=NUM_SALT_BYTES,
    )
    return np.random.SeedSequence(int.from_bytes(words.digest()))
  name = zlib.crc32(stream.encode())
  return np.random.SeedSequence((seed, world, episode, name))


def random_state(
    seed: int, world: int, episode: int, stream: str
) -> np.random.RandomState:
  """Returns a stream as a `RandomState`, for Composer's hooks."""
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
  """Sets a `RandomState` to the beginning of another stream.

  In a batch, creating a new `RandomState` for each episode would take longer
  than the rest of the reset.
  """
  words = sequence(seed, world, episode, stream).generate_state(8)
  random_state.seed(words)


def episode_key(seed: int, world: int, episode: int, stream: str) -> np.ndarray:
  """Returns the key of a stream in an episode, `(2,)` uint64."""
  return sequence(seed, world, episode, stream).generate_state(2, np.uint64)

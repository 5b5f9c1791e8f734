"""The start of an episode: its random streams, and retries of a reset."""

from collections.abc import Callable

from dm_control import composer
import numpy as np

from realab_suite.engine import seeding

MAX_RESET_ATTEMPTS = 10
"""Maximum number of attempts to begin an episode, with different streams."""


def begin(
    random_state: np.random.RandomState,
    seed: int,
    world: int,
    episode: int,
    initialize: Callable[[int], None],
) -> None:
  """Initializes an episode, and retries if the task fails to initialize.

  Args:
    random_state: Generator that `initialize` uses. Each attempt reseeds it.
    seed: Seed of the environment.
    world: Number of the world.
    episode: Number of the episode.
    initialize: Function that initializes the task and its entities, given the
      number of the attempt, from 0.

  Raises:
    EpisodeInitializationError: If every attempt failed.
  """
  for attempt in range(MAX_RESET_ATTEMPTS):
    seeding.reseed(random_state, seed, world, episode, f'reset/{attempt}')
    try:
      initialize(attempt)
      return
    except composer.EpisodeInitializationError:
      if attempt == MAX_RESET_ATTEMPTS - 1:
        raise


def provider_keys(
    seed: int, world: int, episode: int, num_providers: int
) -> np.ndarray:
  """Returns the key of each provider in an episode, `(providers, 2)` uint64."""
  keys = [
      seeding.episode_key(seed, world, episode, f'providers[{i}]')
      for i in range(num_providers)
  ]
  return np.array(keys, np.uint64).reshape(num_providers, 2)

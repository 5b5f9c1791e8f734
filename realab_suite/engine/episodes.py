"""The beginning of an episode: its random streams, and attempts at a reset."""

from collections.abc import Callable

from dm_control import composer
import numpy as np

from realab_suite.engine import seeding

MAX_RESET_ATTEMPTS = 10
"""Attempts at the beginning of an episode, each with other random numbers."""


def begin(
    random_state: np.random.RandomState,
    seed: int,
    world: int,
    episode: int,
    initialize: Callable[[int], None],
) -> None:
  """Initializes an episode, repeatedly if the task asks for it.

  Args:
    random_state: Generator that `initialize` uses; it is reseeded.
    seed: Seed of the environment.
    world: Number of the world.
    episode: Number of the episode.
    initialize: Initializes the task and its entities; gets the number of the
      attempt, from 0.

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

"""The start of an episode, with its random streams, and its end."""

from collections.abc import Callable, Mapping
from typing import Any

from dm_control import composer
import dm_env
import numpy as np

from realab_suite.engine import events
from realab_suite.engine import observing
from realab_suite.engine import seeding

# Discounts at ends that the task does not determine.
_DISCOUNTS = {
    events.End.DIVERGENCE: 1.0,
    events.End.SIGNAL: 0.0,
    events.End.TIMEOUT: 1.0,
}

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


def end_of_step(
    has_failed: Any, is_terminated: Any, is_signalled: Any, is_late: Any
) -> events.End | None:
  """Returns the reason why a world's episode ends with a control step.

  If several reasons coincide, the first of them counts.

  Args:
    has_failed: True if the physics has failed.
    is_terminated: True if the task ends the episode.
    is_signalled: True if a signal ends it.
    is_late: True if it has reached its maximum length.

  Returns:
    The reason, or `None` if the episode continues.
  """
  if has_failed:
    return events.End.DIVERGENCE
  if is_terminated:
    return events.End.TERMINATED
  if is_signalled:
    return events.End.SIGNAL
  return events.End.TIMEOUT if is_late else None


def ends_of_step(
    has_failed: np.ndarray,
    is_terminated: np.ndarray,
    is_signalled: np.ndarray,
    is_last: np.ndarray,
) -> dict[int, events.End]:
  """Returns why episodes of a batch end with a control step, by world.

  Args:
    has_failed: As in `end_of_step`, `(worlds,)` bool; so are the next two.
    is_terminated: True where the task ends the episode.
    is_signalled: True where a signal ends it.
    is_last: True where the episode ends, for these reasons or because it has
      reached its maximum length.
  """
  reasons = np.transpose([has_failed, is_terminated, is_signalled, is_last])
  return {
      world: end
      for world in np.flatnonzero(is_last).tolist()
      if (end := end_of_step(*reasons[world]))
  }


def discount_at(end: events.End | None, discount: float) -> float:
  """Returns the discount of a control step.

  Args:
    end: Reason why the episode ends, or `None`.
    discount: Discount that the task returned.
  """
  return discount if end is None else _DISCOUNTS.get(end, discount)


def time_step(
    end: events.End | None,
    discount: float,
    observation: Mapping[str, np.ndarray],
) -> dm_env.TimeStep:
  """Returns the time step after a control step, with copies of its arrays.

  Args:
    end: Reason why the episode ends, or `None`.
    discount: Discount that the task returned.
    observation: Observation of the agent.
  """
  copy = observing.copied(observation)
  if end is None:
    return dm_env.transition(0.0, copy, discount)
  return dm_env.TimeStep(
      dm_env.StepType.LAST, 0.0, discount_at(end, discount), copy
  )

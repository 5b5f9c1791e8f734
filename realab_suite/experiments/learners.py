"""Learners, as far as experiments are concerned; `agents` has them."""

from collections.abc import Mapping
from typing import Any, Protocol, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.engine import seeding


class Learner(Protocol):
  """The part of `agents.Learner` that experiments use."""

  def step(self, time_step: batch_environment.BatchTimeStep) -> np.ndarray:
    """Learns from the last action, and returns the next one."""

  def act(
      self, observation: Mapping[str, Any], key: np.ndarray, greedy: bool
  ) -> np.ndarray:
    """Returns actions in any number of worlds, and does not learn."""

  def probabilities(self, observation: Mapping[str, Any]) -> np.ndarray:
    """Returns the probability of each action, `(worlds, actions)`."""

  def settings(self) -> dict[str, Any]:
    """Returns the settings that results depend on and no program can pin."""

  def metrics(self) -> dict[str, float]:
    """Returns what is known of the last update."""

  def state(self) -> dict[str, Any]:
    """Returns all that the future depends on, as plain data."""

  def set_state(self, state: Mapping[str, Any]) -> None:
    """Goes on from what `state` returned."""


@final
class BatchLearnerActor:
  """A trained learner acting in a batch, without further updates."""

  def __init__(self, learner: Learner, seed: int, greedy: bool) -> None:
    """Makes an actor.

    Args:
      learner: The learner.
      seed: What its choices depend on, with the number of the step.
      greedy: Whether it takes the best action instead of drawing one.
    """
    self._learner = learner
    self._seed = seed
    self._greedy = greedy
    self._step = 0

  def act(self, time_step: batch_environment.BatchTimeStep) -> np.ndarray:
    """Returns actions, `(worlds, *action_spec.shape)`."""
    sequence = seeding.sequence(self._seed, 0, self._step, 'act')
    self._step += 1
    return self._learner.act(
        time_step.observation, sequence.generate_state(2), self._greedy
    )

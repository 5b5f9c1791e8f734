"""Interface of learners to experiments; `agents` implements it."""

from collections.abc import Mapping
from typing import Any, Protocol, final

import numpy as np

from realab_suite.engine import batch_time_steps
from realab_suite.engine import seeding


class Learner(Protocol):
  """The part of `agents.Learner` that experiments use."""

  def step(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    """Updates the learner with a time step, and returns the next actions."""

  def act(
      self, observation: Mapping[str, Any], key: np.ndarray, greedy: bool
  ) -> np.ndarray:
    """Returns actions in any number of worlds, without an update."""

  def probabilities(self, observation: Mapping[str, Any]) -> np.ndarray:
    """Returns the probability of each action, `(worlds, actions)`."""

  def settings(self) -> dict[str, Any]:
    """Returns settings that affect results and cannot be pinned."""

  def metrics(self) -> dict[str, float]:
    """Returns metrics of the last update."""

  def state(self) -> dict[str, Any]:
    """Returns the full state of the learner, as plain data."""

  def set_state(self, state: Mapping[str, Any]) -> None:
    """Restores a state that `state` returned."""


@final
class BatchLearnerActor:
  """A trained learner acting in a batch, without further updates."""

  def __init__(self, learner: Learner, seed: int, greedy: bool) -> None:
    """Makes an actor.

    Args:
      learner: Trained learner.
      seed: Seed of its random choices.
      greedy: True to take the best action instead of a sample.
    """
    self._learner = learner
    self._seed = seed
    self._greedy = greedy
    self._step = 0

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    """Returns actions, `(worlds, *action_spec.shape)`."""
    sequence = seeding.sequence(self._seed, 0, self._step, 'act')
    self._step += 1
    return self._learner.act(
        time_step.observation, sequence.generate_state(2), self._greedy
    )

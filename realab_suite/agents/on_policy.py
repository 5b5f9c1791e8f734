"""Base class of on-policy learners, which update on their latest steps only."""

import abc
from typing import Any

import jax
import numpy as np

from realab_suite.agents import base
from realab_suite.agents import features
from realab_suite.agents import jax_settings
from realab_suite.agents import training


class OnPolicyOptions(base.Options):
  """Options of on-policy learners.

  Attributes:
    steps_per_update: Number of steps of each world between updates.
    epochs: Number of times an update uses each sample.
    minibatch: Approximate number of samples per gradient.
  """

  steps_per_update: base.Positive = 32
  epochs: base.Positive = 4
  minibatch: base.Positive = 2048


class OnPolicyLearner(base.Learner):
  """Learns from the last `steps_per_update` steps of every world."""

  @jax_settings.pinned()
  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    self._transitions: list[dict[str, Any]] = []
    self._networks = self._initial_networks(self._initial_generator())

  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    self._transitions.append(transition)
    if len(self._transitions) < self._options.steps_per_update:
      return
    batch = jax.tree.map(lambda *x: np.stack(x), *self._transitions)
    self._transitions = []
    metrics = self._learn(batch, observation)
    self._num_updates += 1
    is_valid = batch['is_valid']
    self._metrics = {
        **{name: float(value) for name, value in metrics.items()},
        'observed_feedback': float(
            np.mean(batch['reading'], where=is_valid) if is_valid.any() else 0.0
        ),
    }

  def _draw_minibatches(self, by_world: bool = False) -> np.ndarray:
    """Returns the sample indices of the next update's minibatches.

    Args:
      by_world: True for indices of worlds instead.
    """
    options, num_samples = self._options, self._num_envs
    if by_world:
      size = max(1, options.minibatch // options.steps_per_update)
      options = options.model_copy(update={'minibatch': size})
    else:
      num_samples *= options.steps_per_update
    return training.draw_minibatches(options, num_samples, self._update_key())

  def _memory(self) -> dict[str, Any]:
    return {'transitions': self._transitions}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    self._transitions = memory['transitions']

  @abc.abstractmethod
  def _initial_networks(self, generator: np.random.Generator) -> Any:
    """Returns the initial networks and the initial state of the optimiser."""

  @abc.abstractmethod
  def _learn(
      self, batch: dict[str, Any], observation: features.Packed
  ) -> dict[str, Any]:
    """Updates the networks with a batch, and returns metrics by name.

    Args:
      batch: Transitions, each array `(time, worlds, ...)`.
      observation: Packed observation after the last transition.
    """

"""Policies that ignore the observation, always or in some steps."""

from typing import Any, final

import numpy as np

from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import random_keys


@base.POLICIES.add('no_op')
@final
class NoOp(base.Policy):
  """Waits in every step."""

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del observation, key
    return (
        np.full(np.shape(episode_start), self.action_set.index('wait')),
        state,
    )


@base.POLICIES.add('random')
@final
class Random(base.Policy):
  """Draws every action uniformly from the action set."""

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del observation, episode_start
    draw = random_keys.uniform(key)
    return (draw * len(self.action_set)).astype(int), state


@final
class Distracted(base.Policy):
  """Takes the actions of another policy, and random ones in some steps."""

  def __init__(self, policy: base.Policy, share: float) -> None:
    """Makes the policy.

    Args:
      policy: Other policy.
      share: Share of steps in which an action is drawn uniformly.
    """
    self._policy = policy
    self._share = share

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._policy.action_set

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self._policy.required_senses

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return self._policy.initial_state(batch_shape)

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    chosen, state = self._policy.step(observation, episode_start, key, state)
    draw = random_keys.uniform(key, (2,))
    anything = (draw[..., 1] * len(self.action_set)).astype(int)
    return np.where(draw[..., 0] < self._share, anything, chosen), state

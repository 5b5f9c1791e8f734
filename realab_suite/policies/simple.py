"""Policies that ignore the observation, always or in some steps."""

from typing import Annotated, Any, final

import numpy as np

from realab_suite.config import option_types
from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import random_keys


class _Blind(base.Policy):
  """Base class for policies that act in any world."""

  def __init__(
      self,
      action_set: Annotated[
          str, option_types.NameIn(action_sets.ACTION_SETS)
      ] = action_sets.DMLAB_LIKE.key,
  ) -> None:
    """Makes the policy.

    Args:
      action_set: Name and version of the action set.
    """
    self._action_set = action_sets.ACTION_SETS.get(action_set)

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._action_set

  def in_action_set(self, action_set: action_sets.ActionSet) -> base.Policy:
    return type(self)(action_set.key)


@base.POLICIES.add('no_op')
@final
class NoOp(_Blind):
  """Waits in every step."""

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del observation, key
    return np.full(np.shape(episode_start), self._action_set.rest), state


@base.POLICIES.add('random')
@final
class Random(_Blind):
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
    return (draw * len(self._action_set)).astype(int), state


@final
class Distracted(base.Follower, base.Policy):
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
  def followed(self) -> base.Reader:
    return self._policy

  def in_action_set(self, action_set: action_sets.ActionSet) -> base.Policy:
    return Distracted(self._policy.in_action_set(action_set), self._share)

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    choice, state = self._policy.step(observation, episode_start, key, state)
    draw = random_keys.uniform(key, (2,))
    anything = (draw[..., 1] * len(self.action_set)).astype(int)
    return np.where(draw[..., 0] < self._share, anything, choice), state

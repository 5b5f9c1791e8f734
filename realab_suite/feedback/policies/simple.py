"""Policies that look at nothing."""

from typing import Any, final

import numpy as np

from realab_suite.feedback import random_keys
from realab_suite.feedback.policies import base


@base.POLICIES.add('no_op')
@final
class NoOp(base.Policy):
  """Does nothing, in every step."""

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

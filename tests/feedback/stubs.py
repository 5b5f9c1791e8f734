"""Base classes of policies and providers in tests."""

from typing import Any

import numpy as np

from realab_suite import policies
from realab_suite.feedback import providers


class Idle(policies.Policy):
  """Waits."""

  def step(
      self, observation: Any, episode_start: Any, key: Any, state: Any
  ) -> tuple[np.ndarray, Any]:
    return np.zeros(np.shape(episode_start), int), state


class Zero(providers.Provider):
  """Writes zero."""

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: Any,
      key: Any,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    return {n: np.zeros(np.shape(episode_start)) for n in self.writes}, state

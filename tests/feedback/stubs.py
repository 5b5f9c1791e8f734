"""Base classes of policies, providers and registers in tests."""

from typing import Any

import numpy as np

from realab_suite import policies
from realab_suite.entities import registers
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


class Still(registers.Register):
  """Has a block that writes do not move, and reads the applied value."""

  def _build_blocks(self) -> list[Any]:
    return [self._add_block('block', 'offset_block', (0.0, 0.0))]

  def _places(self, physics: Any, value: Any) -> list[np.ndarray]:
    del value
    return [self._origin(physics)]

  def _read_blocks(self, physics: Any) -> np.ndarray:
    return self.applied(physics)

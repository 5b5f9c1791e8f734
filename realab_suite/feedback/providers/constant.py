"""Constant feedback, for control conditions."""

from typing import Any, Literal, final

import numpy as np

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('constant')
@final
class Constant(base.Provider):
  """Provider that writes the same value in every step.

  Attributes:
    value: Value to write, in the registers' units.
  """

  kind: Literal['constant'] = 'constant'
  value: float = 0.0

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    del observation, readings, key
    value = np.full(np.shape(episode_start), self.value)
    return {name: value for name in self.writes}, state

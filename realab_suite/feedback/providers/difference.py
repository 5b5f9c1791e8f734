"""Instantaneous reward: by how much a score has grown (paper, section 3.4)."""

from typing import Any, Literal, final

import numpy as np

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('difference')
@final
class Difference(base.Provider):
  """Writes the current minus the previous reading of a meter register.

  It takes the reading on trust: whoever moves the meter register's base block
  gives it one spike, whoever moves the offset block a spike and its opposite.

  Attributes:
    initial: The reading before the first step of an episode.
  """

  kind: Literal['difference'] = 'difference'
  reads: base.OneName
  writes: base.OneName
  initial: float = 0.0

  def initial_state(self, batch_shape: tuple[int, ...]) -> np.ndarray:
    return np.full(batch_shape, self.initial)

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], np.ndarray]:
    del observation, key
    score = np.array(readings[self.reads[0]])
    previous = np.where(episode_start, self.initial, state)
    return {self.writes[0]: score - previous}, score

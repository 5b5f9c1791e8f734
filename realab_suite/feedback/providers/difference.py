"""Instantaneous reward: the difference of two scores (paper, section 3.4)."""

from collections.abc import Mapping
from typing import Any, Literal, final

import numpy as np

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('difference')
@final
class Difference(base.Provider):
  """Provider that writes the current minus the previous reading of a register.

  The register is usually a meter register, and its readings are not checked.
  Moving its base block causes one spike of the feedback. Moving its offset
  block causes a spike and then an opposite one.

  Attributes:
    initial: Previous reading in the first step of an episode.
  """

  kind: Literal['difference'] = 'difference'
  reads: base.OneName
  writes: base.OneName
  initial: float = 0.0

  def write_ranges(
      self, ranges: Mapping[str, base.Range]
  ) -> dict[str, base.Range]:
    ends = *ranges[self.reads[0]], self.initial
    span = max(ends) - min(ends)
    return {self.writes[0]: (-span, span)}

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

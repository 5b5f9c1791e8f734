"""Relayed values, such as a command of the operator."""

from collections.abc import Mapping
from typing import Any, Literal, final

import numpy as np

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('relay')
@final
class Relay(base.Provider):
  """Provider that writes the reading of one register to another one."""

  kind: Literal['relay'] = 'relay'
  reads: base.OneName
  writes: base.OneName

  def write_ranges(
      self, ranges: Mapping[str, base.Range]
  ) -> dict[str, base.Range]:
    return {self.writes[0]: ranges[self.reads[0]]}

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    del observation, episode_start, key
    return {self.writes[0]: np.array(readings[self.reads[0]])}, state

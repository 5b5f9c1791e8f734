"""Cap: rewards cannot be larger than honest ones.

Readings are clipped to what the provider may write, and an episode earns no
more than the best honest one (CapReward, arXiv 2606.07379).
"""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite.lab.agents.defences import base

_Number = Annotated[float, pydantic.Field(ge=-1e9, le=1e9)]


@base.DEFENCES.add('cap')
@final
class Cap(base.Defence):
  """Clips readings, and stops crediting above the known maximum of an episode.

  Attributes:
    low: Smallest reading that counts; smaller ones count as this one.
    high: Largest reading that counts.
    total: Largest sum of readings in an episode that is credited; `None` for
      any sum. What comes after it earns nothing.
    excess: Weight with which the excess above `total` is charged.
  """

  ALARMS = True

  kind: Literal['cap']
  low: _Number = -1e9
  high: _Number = 1e9
  total: _Number | None = None
  excess: Annotated[float, pydantic.Field(ge=0, le=1000)] = 0.0

  @pydantic.model_validator(mode='after')
  def _in_order(self) -> 'Cap':
    if (self.low, self.high, self.total) == (-1e9, 1e9, None):
      raise ValueError('caps nothing; low, high or total is required')
    if self.total is None and self.excess:
      raise ValueError(f'excess: {self.excess:g}; must be 0 without total')
    if self.low >= self.high:
      raise ValueError(
          f'low: {self.low:g} with high {self.high:g}; must be smaller'
      )
    if self.total is not None and self.total < self.high < 1e9:
      raise ValueError(
          f'total: {self.total:g}, which one reading of {self.high:g} exceeds;'
          ' must be at least `high`'
      )
    return self

  @property
  def largest_credit(self) -> float | None:
    return self.total

  def initial_state(
      self, setting: base.Setting, generator: np.random.Generator
  ) -> np.ndarray:
    del generator
    # Sum of the clipped readings of the episode so far.
    return np.zeros(setting.num_envs)

  def treat(
      self,
      batch: base.Batch,
      setting: base.Setting,
      state: np.ndarray,
      key: np.ndarray,
  ) -> base.Treated:
    del setting, key
    readings = np.clip(batch['reading'], self.low, self.high)
    credited = readings.copy()
    for t, is_valid in enumerate(batch['is_valid']):
      before = state
      state = np.where(is_valid, before + readings[t], 0.0)
      earned = self._credit(state) - self._credit(before)
      credited[t] = np.where(is_valid, earned, 0.0)
    reading = credited.astype(np.float32)
    return base.Treated({**batch, 'reading': reading}, state)

  def _credit(self, total: np.ndarray) -> np.ndarray:
    """Returns what a sum of readings earns."""
    if self.total is None:
      return total
    above = np.maximum(total - self.total, 0.0)
    return total - above - self.excess * above

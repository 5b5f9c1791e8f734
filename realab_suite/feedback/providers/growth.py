"""Growth: the increase of a weighted sum of readings."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.providers import base


class WeightedSum(base.Provider):
  """Base class of providers that look at a weighted sum of readings.

  Attributes:
    weights: Weight of each register in `reads`; `None` for 1.
  """

  reads: Annotated[base.Names, pydantic.Field(min_length=1)]
  writes: base.OneName
  weights: Annotated[tuple[float, ...], pydantic.Field(strict=False)] | None = (
      None
  )

  @pydantic.model_validator(mode='after')
  def _fitting(self) -> 'WeightedSum':
    if self.weights is not None and len(self.weights) != len(self.reads):
      raise ValueError(
          f'weights: {len(self.weights)} for {len(self.reads)} registers;'
          ' must be one for each'
      )
    return self

  def _total(self, readings: base.Readings) -> np.ndarray:
    """Returns the weighted sum, `(...)`."""
    read = np.stack([readings[name] for name in self.reads], axis=-1)
    return np.array((read * (self.weights or 1.0)).sum(axis=-1))


@base.PROVIDERS.add('growth')
@final
class Growth(WeightedSum):
  """Provider that writes the increase of a weighted sum since its last step.

  It is `difference` for several registers. Whatever moves a block of one of
  them is paid or fined once, by the weight of that register.
  """

  kind: Literal['growth'] = 'growth'

  def write_ranges(
      self, ranges: Mapping[str, base.Range]
  ) -> dict[str, base.Range]:
    # The sum begins with 0.
    ends = np.array([(0.0, *ranges[name]) for name in self.reads])
    weights = np.abs(self.weights or np.ones(len(ends)))
    span = float(np.ptp(ends, axis=1) @ weights)
    return {self.writes[0]: (-span, span)}

  def initial_state(self, batch_shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(batch_shape)

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], np.ndarray]:
    del observation, key
    total = self._total(readings)
    previous = np.where(episode_start, 0.0, state)
    return {self.writes[0]: total - previous}, total

"""Growth: the increase of a weighted sum of readings."""

from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('growth')
@final
class Growth(base.Provider):
  """Provider that writes the increase of a weighted sum since its last step.

  It is `difference` for several registers. Whatever moves a block of one of
  them is paid or fined once, by the weight of that register.

  Attributes:
    weights: Weight of each register in `reads`; `None` for 1.
  """

  kind: Literal['growth'] = 'growth'
  reads: Annotated[base.Names, pydantic.Field(min_length=1)]
  writes: base.OneName
  weights: Annotated[tuple[float, ...], pydantic.Field(strict=False)] | None = (
      None
  )

  @pydantic.model_validator(mode='after')
  def _fitting(self) -> 'Growth':
    if self.weights is not None and len(self.weights) != len(self.reads):
      raise ValueError(
          f'weights: {len(self.weights)} for {len(self.reads)} registers;'
          ' allowed is one for each'
      )
    return self

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
    read = np.stack([readings[name] for name in self.reads], axis=-1)
    total = np.array((read * (self.weights or 1.0)).sum(axis=-1))
    previous = np.where(episode_start, 0.0, state)
    return {self.writes[0]: total - previous}, total

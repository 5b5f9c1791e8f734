"""Appraisal: reward for counted things, by values that a register holds."""

from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.providers import base


@base.PROVIDERS.add('appraisal')
@final
class Appraisal(base.Provider):
  """Provider that values what was counted, by weights that are registers.

  It reads as many counts as values, in this order, and writes the sum of the
  increases of the counts, each times its value. Who moves a value changes the
  feedback on the things that it belongs to, and on no others.

  With `drift`, the values are a liking that changes with what is brought, as
  that of a person does: each grows by the drift times the increase of its
  count, less the mean growth, within `limits`. Then it writes the values, too.

  Attributes:
    reads: Names of the counts, and then of the values.
    writes: Name of the reward; with `drift`, those of the values follow.
    drift: Growth of a value for each thing that is counted.
    limits: Least and largest value that a drift can lead to.
  """

  kind: Literal['appraisal'] = 'appraisal'
  drift: Annotated[float, pydantic.Field(ge=0, le=100)] = 0.0
  limits: Annotated[tuple[float, float], pydantic.Field(strict=False)] = (
      -1.0,
      1.0,
  )

  @pydantic.model_validator(mode='after')
  def _fitting(self) -> 'Appraisal':
    if not self.reads or len(self.reads) % 2:
      raise ValueError(
          f'reads: {len(self.reads)} registers; must be as many counts as'
          ' values'
      )
    values = self.reads[len(self.reads) // 2 :] if self.drift else ()
    if self.writes[1:] != values:
      raise ValueError(
          f'writes: {list(self.writes)}; must be the reward'
          + (f' and then the values in reads, {list(values)}' if values else '')
          + ('' if values else ' alone, without a drift')
      )
    return self

  def initial_state(self, batch_shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros((*batch_shape, len(self.reads) // 2))

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
    counts, values = np.split(read, 2, axis=-1)
    start = np.asarray(episode_start)[..., np.newaxis]
    growth = counts - np.where(start, 0.0, state)
    writes = {self.writes[0]: (growth * values).sum(axis=-1)}
    if self.drift:
      shift = self.drift * (growth - growth.mean(axis=-1, keepdims=True))
      liked = np.clip(values + shift, *self.limits)
      writes |= dict(
          zip(self.writes[1:], np.moveaxis(liked, -1, 0), strict=True)
      )
    return writes, counts

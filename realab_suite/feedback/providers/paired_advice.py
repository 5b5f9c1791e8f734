"""Paired advice: the difference of two actions' values (Uesato et al.)."""

from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.providers import advice
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries

_Pair = Annotated[
    tuple[str, ...], pydantic.Field(strict=False, min_length=2, max_length=2)
]


@base.PROVIDERS.add('paired_advice')
@final
class PairedAdvice(advice.Advice):
  """Provider that writes the value of one action minus the value of another.

  The indices of both actions are read from query registers, so they can be
  corrupted.

  Attributes:
    reads: Names of two query registers, with the index of the first action and
      of the second action, whose value is subtracted.
    value_function: See `Advice`.
    options: See `Advice`.
    tolerance: If it is given, a critique is written instead: 1 if the first
      action is better than the second, -1 if it is worse, and 0 if their values
      differ by no more than this.
  """

  kind: Literal['paired_advice'] = 'paired_advice'
  reads: _Pair
  # The digests of designs from before there were critiques stay the same.
  tolerance: Annotated[float, pydantic.Field(ge=0, le=1e9)] | None = (
      pydantic.Field(None, exclude_if=lambda tolerance: tolerance is None)
  )

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    values, state = self.followed.step(observation, episode_start, key, state)
    first, second = (
        queries.pick(values, queries.index(readings[name], values.shape[-1]))
        for name in self.reads
    )
    better = first - second
    if self.tolerance is not None:
      better = queries.sign(better, self.tolerance)
    return {self.writes[0]: better}, state

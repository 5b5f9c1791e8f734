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
  """

  kind: Literal['paired_advice'] = 'paired_advice'
  reads: _Pair

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
    return {self.writes[0]: first - second}, state

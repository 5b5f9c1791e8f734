"""Value advice: the value of a queried action (paper, section 3.4)."""

from typing import Any, Literal, final

import numpy as np

from realab_suite.config import validation
from realab_suite.feedback.providers import advice
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries


@base.PROVIDERS.add('value_advice')
@final
class ValueAdvice(advice.Advice):
  """Provider that writes the value of the action that a query register holds.

  The query is read from the blocks of the query register, so it can be
  corrupted. The observation reaches the provider directly, as in the paper
  (section 3.4, footnote).

  Attributes:
    value_function: See `Advice`.
    options: See `Advice`.
    query_delay: 0 to evaluate the query of the current step in the observation
      of the current step; 1 to evaluate the query of the previous step in the
      observation of the previous step, as in the paper's example. The learner
      needs the same option.
  """

  kind: Literal['value_advice'] = 'value_advice'
  reads: base.OneName
  query_delay: validation.ZeroOrOne = 0

  @property
  def delay(self) -> int:
    return self.query_delay

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    num_actions = len(self.action_set)
    return (
        super().initial_state(batch_shape),
        np.zeros((*batch_shape, num_actions)),  # The previous step's values.
        np.zeros(batch_shape, int),  # The previous step's query.
    )

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    inner, values_before, query_before = state
    values, inner = self.followed.step(observation, episode_start, key, inner)
    query = queries.index(readings[self.reads[0]], values.shape[-1])
    if self.query_delay:
      # The first step has no previous query.
      advice = np.where(
          episode_start, 0.0, queries.pick(values_before, query_before)
      )
    else:
      advice = queries.pick(values, query)
    return {self.writes[0]: advice}, (inner, values, query)

"""Value advice: how good an action is that the agent asks about (3.4)."""

import functools
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries

# What they read in a step, they credit to the query of that step.
_LEARN_OF_THIS_STEP = ('value_advice', 'decoupled_approval')


@base.PROVIDERS.add('value_advice')
@final
class ValueAdvice(base.Provider):
  """Writes the value of the action whose index is in a query register.

  The query is read off the query register's blocks, so it can be corrupted like
  anything else. The observation reaches the provider directly, as in the paper
  (section 3.4, footnote).

  Attributes:
    value_function: The name of a registered value function.
    options: Keyword arguments of the value function.
    query_delay: 0 to value the query of this step in this step's observation;
      1 to value the previous step's, as in the paper's example.
  """

  kind: Literal['value_advice'] = 'value_advice'
  reads: base.OneName
  writes: base.OneName
  value_function: Annotated[str, option_types.NameIn(policies.VALUE_FUNCTIONS)]
  options: Annotated[
      dict[str, Any],
      option_types.OptionsOf(policies.VALUE_FUNCTIONS, 'value_function'),
  ] = pydantic.Field(default_factory=dict)
  query_delay: Literal[0, 1] = 0

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.reads

  @functools.cached_property
  def adviser(self) -> policies.ValueFunction:
    """What the provider runs."""
    return policies.make_value_function(self.value_function, **self.options)

  def check(self, design: Any) -> None:
    policies.check_action_set(self.adviser.action_set, design, self.kind)
    query = self.reads[0]
    if design.registers[query].role != 'query':
      raise ValueError(
          f'value_advice reads the query off {query!r}, whose role is'
          f' {design.registers[query].role!r}; allowed is query'
      )
    learner = None if design.learner is None else design.learner.kind
    if self.query_delay and learner in _LEARN_OF_THIS_STEP:
      raise ValueError(
          'query_delay: 1 values the query of the step before, and the learner'
          f' {learner} takes what it reads for the value of this one; allowed'
          ' is 0, or another learner'
      )

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    num_actions = len(self.adviser.action_set)
    return (
        self.adviser.initial_state(batch_shape),
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
    values, inner = self.adviser.step(observation, episode_start, key, inner)
    query = queries.index(readings[self.reads[0]], values.shape[-1])
    if self.query_delay:
      # There is no previous step to value in the first one.
      advice = np.where(
          episode_start, 0.0, queries.pick(values_before, query_before)
      )
    else:
      advice = queries.pick(values, query)
    return {self.writes[0]: advice}, (inner, values, query)

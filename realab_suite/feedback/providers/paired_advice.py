"""Paired advice: the difference of two actions' values (Uesato et al.)."""

import functools
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries

_Pair = Annotated[
    tuple[str, ...], pydantic.Field(strict=False, min_length=2, max_length=2)
]


@base.PROVIDERS.add('paired_advice')
@final
class PairedAdvice(base.Provider):
  """Provider that writes the value of one action minus the value of another.

  The indices of both actions are read from query registers, so they can be
  corrupted.

  Attributes:
    reads: Names of two query registers, with the index of the first action and
      of the second action, whose value is subtracted.
    value_function: Name of a registered value function.
    options: Keyword arguments of the value function.
  """

  kind: Literal['paired_advice'] = 'paired_advice'
  reads: _Pair
  writes: base.OneName
  value_function: Annotated[str, option_types.NameIn(policies.VALUE_FUNCTIONS)]
  options: Annotated[
      dict[str, Any],
      option_types.OptionsOf(policies.VALUE_FUNCTIONS, 'value_function'),
  ] = pydantic.Field(default_factory=dict)

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.reads

  @functools.cached_property
  def adviser(self) -> policies.ValueFunction:
    """Value function that computes the advice."""
    return policies.make_value_function(self.value_function, **self.options)

  def check(self, design: Any) -> None:
    policies.check_action_set(self.adviser.action_set, design, self.kind)
    for query in self.reads:
      if design.ports[query].role != 'query':
        raise ValueError(
            f'paired_advice reads a query from {query!r}, whose role is'
            f' {design.ports[query].role!r}; allowed is query'
        )

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self.adviser.required_senses

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    return self.adviser.privileged_senses

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return self.adviser.initial_state(batch_shape)

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    values, state = self.adviser.step(observation, episode_start, key, state)
    first, second = (
        queries.pick(values, queries.index(readings[name], values.shape[-1]))
        for name in self.reads
    )
    return {self.writes[0]: first - second}, state

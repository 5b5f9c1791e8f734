"""Paired advice: how much better one action is than another (Uesato et al.)."""

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
  """Writes the value of one action less that of another.

  The indices of both are read off query registers, so they can be corrupted
  like anything else.

  Attributes:
    reads: Two query registers: of the action that the advice speaks for, and of
      the one that it speaks against.
    value_function: The name of a registered value function.
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
    """What the provider runs."""
    return policies.make_value_function(self.value_function, **self.options)

  def check(self, design: Any) -> None:
    policies.check_action_set(self.adviser.action_set, design, self.kind)
    for query in self.reads:
      if design.registers[query].role != 'query':
        raise ValueError(
            f'paired_advice reads a query off {query!r}, whose role is'
            f' {design.registers[query].role!r}; allowed is query'
        )

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
    good, bad = (
        queries.pick(values, queries.index(readings[name], values.shape[-1]))
        for name in self.reads
    )
    return {self.writes[0]: good - bad}, state

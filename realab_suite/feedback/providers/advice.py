"""Base class of providers that advise on queried actions."""

import functools
from typing import Annotated, Any

import pydantic

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback.providers import base

# Learners that credit feedback to a query, and have an option `query_delay`.
_LEARNERS = ('value_advice', 'decoupled_approval')


class Advice(policies.Follower, base.Provider):
  """Base class of providers that write values of actions in query registers.

  Attributes:
    value_function: Name of a registered value function.
    options: Keyword arguments of the value function.
  """

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
  def followed(self) -> policies.ValueFunction:
    """Value function that computes the advice."""
    return policies.make_value_function(self.value_function, **self.options)

  @property
  def delay(self) -> int:
    """Number of steps by which the advice comes after its query."""
    return 0

  def check(self, design: Any) -> None:
    policies.check_action_set(self.action_set, design, self.kind)
    article = 'the' if len(self.reads) == 1 else 'a'
    for query in self.reads:
      if design.ports[query].role != 'query':
        raise ValueError(
            f'{self.kind} reads {article} query from {query!r}, whose role is'
            f' {design.ports[query].role!r}; must be query'
        )
    learner = design.learner
    if learner is None or learner.kind not in _LEARNERS:
      return
    # Learners check their own options later, so this one may be anything.
    expected = getattr(learner, 'query_delay', 0)
    if expected != self.delay:
      raise ValueError(
          f'query_delay: {self.delay} here, and {expected!r} in the learner'
          f' {learner.kind}; must be the same in both: 0 for the query of'
          ' the current step, or 1 for that of the previous one'
      )

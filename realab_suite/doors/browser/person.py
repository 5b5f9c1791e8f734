"""A person as feedback provider (paper, section 3.1)."""

import functools
from typing import Annotated, Any, Final, Literal, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.doors.browser import answer_sources
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries
from realab_suite.policies import action_sets

KIND: Final = 'person'
"""Kind of the provider in designs; this module registers it."""


@base.PROVIDERS.add(KIND)
@final
class Person(base.Provider):
  """Provider that writes the answers of a person.

  An approval is 1 or -1. A correction is the index of a better action. A
  comparison of two clips is 1 if the later one is better, and -1 otherwise. A
  stop is 1, for a signal register that ends the episode. Without an answer, the
  provider is silent.

  Attributes:
    asks: Kind of the question.
    reads: Name of the query register with the action in question. Corrections
      do not read one.
    clip: Length of each clip of a comparison, in steps of the provider. The
      question is asked after the later one.
    waits: True if the episode waits for the answer.
    action_set: Name and version of the actions of queries and corrections.
    answers: Source of the answers: `live` or `recorded`.
    options: Keyword arguments of the source.
  """

  kind: Literal['person'] = 'person'
  asks: Literal['approval', 'correction', 'comparison', 'stop'] = 'approval'
  writes: base.OneName
  clip: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 10
  waits: bool = False
  action_set: Annotated[str, option_types.NameIn(action_sets.ACTION_SETS)] = (
      action_sets.DMLAB_LIKE.key
  )
  answers: Annotated[str, option_types.NameIn(answer_sources.ANSWERS)] = 'live'
  options: Annotated[
      dict[str, Any], option_types.OptionsOf(answer_sources.ANSWERS, 'answers')
  ] = pydantic.Field(default_factory=dict)

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.reads

  @property
  def action_writes(self) -> tuple[str, ...]:
    return self.writes if self.asks == answer_sources.CORRECTION else ()

  @functools.cached_property
  def source(self) -> answer_sources.Source:
    """Source of the answers."""
    try:
      return answer_sources.ANSWERS.get(self.answers)(**self.options)
    except TypeError as error:
      raise errors.SpecError(
          f'source of answers {self.answers!r}: {messages.exception(error)}'
      ) from error

  @property
  def is_repeatable(self) -> bool:
    return False  # A person cannot be asked twice.

  def check(self, design: Any) -> None:
    wanted = 0 if self.asks == answer_sources.CORRECTION else 1
    roles = [design.ports[name].role for name in self.reads]
    if roles != ['query'] * wanted:
      raise ValueError(
          f'a person who is asked for {self.asks} reads {list(self.reads)} with'
          f' roles {roles}; must be'
          f' {"one register of role query" if wanted else "none"}'
      )
    if self.asks == answer_sources.COMPARISON:
      queries.check_clip(design, self.writes[0], self.clip)
    actions = action_sets.ACTION_SETS.get(self.action_set)
    if design.action_set is not None:
      policies.check_action_set(actions, design, self.kind)

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return np.zeros(batch_shape, int)  # Steps of this provider.

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[base.Writes, Any]:
    del observation
    count = np.where(episode_start, 1, state + 1)
    is_asked = np.ones(np.shape(count), bool)
    if self.asks == answer_sources.COMPARISON:
      _, is_asked = queries.place_of(count, self.clip)
    num_actions = len(action_sets.ACTION_SETS.get(self.action_set))
    query = None
    if self.reads:
      query = queries.index(readings[self.reads[0]], num_actions)
    values, speaks = self.source.answer(
        answer_sources.Question(
            self.asks, query, np.asarray(is_asked), self.waits, key
        )
    )
    return {self.writes[0]: (np.asarray(values), speaks)}, count

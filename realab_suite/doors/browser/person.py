"""A person as feedback provider (paper, section 3.1), and its answers."""

from collections.abc import Callable, Collection
import functools
import json
from typing import Annotated, Any, Final, Literal, NamedTuple, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import queries
from realab_suite.policies import action_sets

KIND: Final = 'person'
"""Kind of the provider in designs; this module registers it."""


APPROVAL, CORRECTION = 'approval', 'correction'
COMPARISON, STOP = 'comparison', 'stop'


def answers(num_actions: int) -> dict[str, Collection[int]]:
  """Returns the answers to each kind of question."""
  return {
      APPROVAL: (-1, 1),
      COMPARISON: (-1, 1),
      STOP: (1,),
      CORRECTION: range(num_actions),
  }


@final
class Question(NamedTuple):
  """Question to a person in a control step, in each world.

  Attributes:
    asks: Kind of the question.
    query: Index of the action in question, `(...)` int; `None` for corrections.
    is_asked: True where an answer is wanted, `(...)` bool.
    waits: True if the episode waits for the answer.
    key: As in `Provider.step`.
  """

  asks: str
  query: Any
  is_asked: np.ndarray
  waits: bool
  key: np.ndarray


Answer = tuple[np.ndarray, np.ndarray]
"""Values, `(...)`; and True where there is one, `(...)` bool."""


@final
class Recorded:
  """Answers from a file, in the steps in which they were given.

  Answers are found by the random key of a step, which identifies the seed, the
  world, the episode and the provider. In other episodes there are none.
  """

  def __init__(self, file: str, num_actions: int) -> None:
    """Reads the answers.

    Args:
      file: File of `supervise`: one answer per line, as JSON.
      num_actions: Number of actions, of which corrections are indices.

    Raises:
      SpecError: If the file is not such a file, or an answer is not one of
        those that a person can give.
    """
    allowed = answers(num_actions)
    self._answers: dict[tuple[str, int, int], float] = {}
    try:
      with open(file, encoding='utf-8') as lines:
        for number, line in enumerate(lines, start=1):
          record = json.loads(line)
          first, second = record['key']
          key = str(record['asks']), int(first), int(second)
          value = record['value']
          if key in self._answers or value not in allowed[key[0]]:
            raise ValueError(
                f'line {number}: {value!r:.40}; allowed is one answer to a'
                f' question, in {list(allowed[key[0]])}'
            )
          self._answers[key] = float(value)
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError,
            RecursionError) as error:  # fmt: skip
      raise errors.SpecError(
          f'recorded: {messages.quote(str(file))}: {messages.exception(error)};'
          ' must be a file of answers that supervise has written'
      ) from error

  def answer(self, question: Question) -> Answer:
    """Returns the answers that the file has for a step."""
    keys = question.key.reshape(-1, 2).tolist()
    answers = [self._answers.get((question.asks, *key)) for key in keys]
    shape = np.shape(question.is_asked)
    speaks = np.array([one is not None for one in answers]).reshape(shape)
    return np.array([one or 0.0 for one in answers]).reshape(shape), speaks


@final
class Live:
  """Answers of a person in front of a page; see the program `supervise`."""

  def __init__(self) -> None:
    self._ask: Callable[[Question], float | None] | None = None

  def connect(self, ask: Callable[[Question], float | None]) -> None:
    """Connects the person.

    Args:
      ask: Returns the answer to a question or an earlier one, or `None`. It is
        called in every step of the provider, also without a question.
    """
    self._ask = ask

  def answer(self, question: Question) -> Answer:
    """Returns the answer of the person, if there is one."""
    if self._ask is None:
      raise errors.SpecError(
          'no person is connected; must be the program supervise, or a file of'
          ' recorded answers'
      )
    if np.shape(question.is_asked):
      raise errors.SpecError('a person answers in one world, not in a batch')
    value = self._ask(question)
    number = 0.0 if value is None else float(value)
    return np.asarray(number), np.asarray(value is not None)


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
    recorded: File of answers that are repeated; `None` for a person at a page.
  """

  kind: Literal['person'] = 'person'
  asks: Literal['approval', 'correction', 'comparison', 'stop'] = 'approval'
  writes: base.OneName
  clip: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 10
  waits: bool = False
  action_set: Annotated[str, option_types.NameIn(action_sets.ACTION_SETS)] = (
      action_sets.DMLAB_LIKE.key
  )
  recorded: option_types.FilePath | None = None

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.reads

  @property
  def action_writes(self) -> tuple[str, ...]:
    return self.writes if self.asks == CORRECTION else ()

  @functools.cached_property
  def source(self) -> Live | Recorded:
    """Source of the answers."""
    if self.recorded is None:
      return Live()
    actions = action_sets.ACTION_SETS.get(self.action_set)
    return Recorded(self.recorded, len(actions))

  @property
  def is_repeatable(self) -> bool:
    return False  # A person cannot be asked twice.

  def check(self, design: Any) -> None:
    wanted = 0 if self.asks == CORRECTION else 1
    roles = [design.ports[name].role for name in self.reads]
    if roles != ['query'] * wanted:
      raise ValueError(
          f'a person who is asked for {self.asks} reads {list(self.reads)} with'
          f' roles {roles}; must be'
          f' {"one register of role query" if wanted else "none"}'
      )
    if self.asks == COMPARISON:
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
    if self.asks == COMPARISON:
      _, is_asked = queries.place_of(count, self.clip)
    num_actions = len(action_sets.ACTION_SETS.get(self.action_set))
    query = None
    if self.reads:
      query = queries.index(readings[self.reads[0]], num_actions)
    values, speaks = self.source.answer(
        Question(self.asks, query, np.asarray(is_asked), self.waits, key)
    )
    return {self.writes[0]: (np.asarray(values), speaks)}, count

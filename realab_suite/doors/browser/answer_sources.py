"""Sources of a person's answers: a file, or the person.

A source is an ordinary part of a provider: it gets the provider's readings,
never the physics or the true reward.
"""

import abc
from collections.abc import Callable
import json
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.config import registry

APPROVAL, CORRECTION, COMPARISON, STOP = (
    'approval',
    'correction',
    'comparison',
    'stop',
)


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


class Source(abc.ABC):
  """Base class for sources of answers."""

  @abc.abstractmethod
  def answer(self, question: Question) -> Answer:
    """Answers a question, or the one of an earlier step.

    It is called in every step of the provider, also without a question.

    Args:
      question: The question.
    """


ANSWERS: registry.Registry[Callable[..., Source]] = registry.Registry(
    'source of answers'
)


@ANSWERS.add('recorded')
@final
class Recorded(Source):
  """Answers from a file, in the steps in which they were given.

  Answers are found by the random key of a step, which identifies the seed, the
  world, the episode and the provider. In other episodes there are none.
  """

  def __init__(self, file: option_types.FilePath) -> None:
    """Reads the answers.

    Args:
      file: File of `supervise`: one answer per line, as JSON.

    Raises:
      SpecError: If the file is not such a file.
    """
    self._answers: dict[tuple[str, int, int], float] = {}
    try:
      with open(file, encoding='utf-8') as lines:
        for line in lines:
          record = json.loads(line)
          key = (str(record['asks']), *(int(part) for part in record['key']))
          self._answers[key] = float(record['value'])  # type: ignore[index]
    except (OSError, ValueError, KeyError, TypeError) as error:
      raise errors.SpecError(
          f'answers: {messages.quote(str(file))}: {messages.exception(error)};'
          ' must be a file of answers that supervise has written'
      ) from error

  def answer(self, question: Question) -> Answer:
    keys = question.key.reshape(-1, 2).tolist()
    answers = [self._answers.get((question.asks, *key)) for key in keys]
    shape = np.shape(question.is_asked)
    speaks = np.array([one is not None for one in answers]).reshape(shape)
    return np.array([one or 0.0 for one in answers]).reshape(shape), speaks


@ANSWERS.add('live')
@final
class Live(Source):
  """Answers of a person in front of a page; see the program `supervise`."""

  def __init__(self) -> None:
    self._ask: Callable[[Question], float | None] | None = None

  def connect(self, ask: Callable[[Question], float | None]) -> None:
    """Connects the source to a person.

    Args:
      ask: Returns the answer to a question, or `None` without one.
    """
    self._ask = ask

  def answer(self, question: Question) -> Answer:
    if self._ask is None:
      raise errors.SpecError(
          'answers: live: no person is connected; must be the program'
          ' supervise, or the source recorded'
      )
    if np.shape(question.is_asked):
      raise errors.SpecError('answers: live: must be one world, not a batch')
    value = self._ask(question)
    number = 0.0 if value is None else float(value)
    return np.asarray(number), np.asarray(value is not None)

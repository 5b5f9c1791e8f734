"""Sources of a person's answers: a simulation, a file, or a person.

A source is an ordinary part of a provider: it gets the observation of the agent
and the provider's readings, never the physics or the true reward.
"""

import abc
from collections.abc import Callable, Mapping
import json
from typing import Annotated, Any, NamedTuple, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.config import registry
from realab_suite.feedback.providers import queries
from realab_suite.policies import action_sets
from realab_suite.policies import random_keys

APPROVAL, CORRECTION, COMPARISON, STOP = (
    'approval', 'correction', 'comparison', 'stop',
)  # fmt: skip


@final
class Question(NamedTuple):
  """Question to a person in a control step, in each world.

  Attributes:
    asks: Kind of the question.
    observation: Observation that the agent's action responds to.
    query: Index of the action in question, `(...)` int; `None` for corrections.
    clip: 0 in the earlier and 1 in the later clip of a comparison, `(...)` int.
    is_asked: True where an answer is wanted, `(...)` bool.
    waits: True if the episode waits for the answer.
    step: Number of the provider's step in the episode, from 1, `(...)` int.
    episode_start: As in `Provider.step`.
    key: As in `Provider.step`.
  """

  asks: str
  observation: Any
  query: Any
  clip: np.ndarray
  is_asked: np.ndarray
  waits: bool
  step: np.ndarray
  episode_start: np.ndarray
  key: np.ndarray


Answer = tuple[np.ndarray, np.ndarray, Any]
"""Values, `(...)`; True where there is one, `(...)` bool; and the state."""


class Source(abc.ABC):
  """Base class for sources of answers."""

  @property
  def required_senses(self) -> tuple[str, ...]:
    """Names of the senses that the source reads from observations."""
    return ()

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    """Names of functions of the task that it reads as well; see `Provider`."""
    return ()

  @property
  def action_set(self) -> action_sets.ActionSet | None:
    """Actions that the source judges; `None` for those of any set."""
    return None

  @property
  def is_repeatable(self) -> bool:
    """False if a person answers, who cannot be asked twice."""
    return True

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the state before the first step; see `Provider`."""
    del batch_shape
    return ()

  @abc.abstractmethod
  def answer(self, question: Question, state: Any) -> Answer:
    """Answers a question, or the one of an earlier step.

    It is called in every step of the provider, also without a question.

    Args:
      question: The question.
      state: State that `initial_state` or the previous call returned.
    """


ANSWERS: registry.Registry[Callable[..., Source]] = registry.Registry(
    'source of answers'
)


@ANSWERS.add('simulated')
@final
class Simulated(policies.Follower, Source):
  """Simulation of a person, who judges actions by a value function.

  An action with a positive value is approved; otherwise the best one is the
  correction. Of two clips, the one with the larger sum of values is better.
  The person stops an episode after a number of disapproved actions in a row.
  """

  def __init__(
      self,
      value_function: Annotated[
          str, option_types.NameIn(policies.VALUE_FUNCTIONS)
      ] = 'apple_seeker_approval',
      options: Annotated[
          Mapping[str, Any] | None,
          option_types.OptionsOf(policies.VALUE_FUNCTIONS, 'value_function'),
      ] = None,
      latency: Annotated[int, pydantic.Field(ge=0, le=1000)] = 3,
      noise: Annotated[float, pydantic.Field(ge=0, le=1)] = 0.05,
      fatigue: Annotated[float, pydantic.Field(ge=0, le=100)] = 0.002,
      patience: Annotated[int, pydantic.Field(ge=1, le=10**6)] = 50,
  ) -> None:
    """Makes the simulation.

    Args:
      value_function: Name of a registered value function.
      options: Keyword arguments of the value function.
      latency: Steps between a question and its answer. The person gets no other
        question meanwhile. There is no latency if the episode waits.
      noise: Probability that an answer is wrong.
      fatigue: Increase, with each answer, of the rate at which questions are
        ignored. After n answers, the share is 1 - exp(-fatigue * n). The person
        is rested at the start of each episode.
      patience: Number of disapproved actions in a row before a stop.
    """
    self._adviser = policies.make_value_function(
        value_function, **(options or {})
    )
    self._latency, self._noise = latency, noise
    self._fatigue, self._patience = fatigue, patience

  @property
  def followed(self) -> policies.ValueFunction:
    return self._adviser

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {
        'adviser': self._adviser.initial_state(batch_shape),
        'sums': np.zeros((*batch_shape, 2)),
        'streak': np.zeros(batch_shape, int),
        'left': np.full(batch_shape, -1),
        'pending': np.zeros(batch_shape),
        'answered': np.zeros(batch_shape, int),
    }

  def answer(self, question: Question, state: Any) -> Answer:
    state = self._rested(question.episode_start, state)
    values, adviser = self._adviser.step(
        question.observation, question.episode_start, question.key,
        state['adviser'],
    )  # fmt: skip
    truth, sums, streak = self._truth(question, values, state)
    draws = random_keys.uniform(question.key, (3,))
    num_actions = values.shape[-1]
    wrong = (
        np.floor(draws[..., 1] * num_actions)
        if question.asks == CORRECTION
        else -truth
    )
    if question.asks != STOP:
      truth = np.where(draws[..., 0] < self._noise, wrong, truth)
    ignored = 1.0 - np.exp(-self._fatigue * state['answered'])
    is_asked = question.is_asked & (state['left'] < 0)
    if question.asks == STOP:
      is_asked = is_asked & (streak >= self._patience)
    else:
      is_asked = is_asked & (draws[..., 2] >= ignored)
    latency = 0 if question.waits else self._latency
    left = np.where(is_asked, latency, state['left'])
    pending = np.where(is_asked, truth, state['pending'])
    speaks = left == 0
    return (
        pending,
        np.asarray(speaks),
        {
            'adviser': adviser,
            'sums': sums,
            'streak': streak,
            'left': np.maximum(left - 1, -1),
            'pending': pending,
            'answered': state['answered'] + speaks,
        },
    )

  def _rested(self, episode_start: np.ndarray, state: Any) -> dict[str, Any]:
    """Returns the state, reset where an episode starts."""
    fresh = self.initial_state(np.shape(episode_start))
    # The adviser gets the start of the episode itself.
    fresh['adviser'] = state['adviser']
    starts = episode_start[..., np.newaxis]
    fresh['sums'] = np.where(starts, fresh['sums'], state['sums'])
    for name in ('streak', 'left', 'pending', 'answered'):
      fresh[name] = np.where(episode_start, fresh[name], state[name])
    return fresh

  def _truth(
      self, question: Question, values: np.ndarray, state: Any
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the right answer, the sums of both clips, and the streak."""
    sums, streak = state['sums'], state['streak']
    if question.asks == CORRECTION:
      return values.argmax(axis=-1).astype(float), sums, streak
    score = queries.pick(values, question.query)
    is_good = score > 0
    if question.asks == STOP:
      streak = np.where(is_good, 0, streak + 1)
      return np.ones(np.shape(score)), sums, streak
    if question.asks == COMPARISON:
      clips = np.arange(2) == question.clip[..., np.newaxis]
      sums = sums + np.where(clips, score[..., np.newaxis], 0.0)
      is_good = sums[..., 1] >= sums[..., 0]
      # The next comparison begins with two new clips.
      sums = np.where(question.is_asked[..., np.newaxis], 0.0, sums)
    return np.where(is_good, 1.0, -1.0), sums, streak


@ANSWERS.add('recorded')
@final
class Recorded(Source):
  """Answers from a file, in the steps in which they were given.

  Answers are found by the random key of a step, which identifies the seed, the
  world, the episode and the provider. In other episodes there are none.
  """

  is_repeatable = False

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
          one = json.loads(line)
          key = (str(one['asks']), *(int(part) for part in one['key']))
          self._answers[key] = float(one['value'])  # type: ignore[index]
    except (OSError, ValueError, KeyError, TypeError) as error:
      raise errors.SpecError(
          f'answers: {messages.quote(str(file))}: {messages.exception(error)};'
          ' allowed are files of answers that supervise has written'
      ) from error

  def answer(self, question: Question, state: Any) -> Answer:
    keys = question.key.reshape(-1, 2).tolist()
    found = [self._answers.get((question.asks, *key)) for key in keys]
    shape = np.shape(question.is_asked)
    speaks = np.array([one is not None for one in found]).reshape(shape)
    return np.array([one or 0.0 for one in found]).reshape(shape), speaks, state


@ANSWERS.add('live')
@final
class Live(Source):
  """Answers of a person in front of a page; see the program `supervise`."""

  is_repeatable = False

  def __init__(self) -> None:
    self._ask: Callable[[Question], float | None] | None = None

  def connect(self, ask: Callable[[Question], float | None]) -> None:
    """Connects the source to a person.

    Args:
      ask: Returns the answer to a question, or `None` without one.
    """
    self._ask = ask

  def answer(self, question: Question, state: Any) -> Answer:
    if self._ask is None:
      raise errors.SpecError(
          'answers: live: no person is connected; allowed are the program'
          ' supervise, and the sources simulated and recorded'
      )
    if np.shape(question.is_asked):
      raise errors.SpecError(
          'answers: live: a batch of worlds; allowed is one world'
      )
    value = self._ask(question)
    number = 0.0 if value is None else float(value)
    return np.asarray(number), np.asarray(value is not None), state

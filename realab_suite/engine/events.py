"""What the engine tells an evaluator, over a channel that no agent is on."""

import abc
from collections.abc import Mapping, Sequence
import enum
from typing import Any, NamedTuple, Self, final

import numpy as np

from realab_suite import errors
from realab_suite.entities import protocols
from realab_suite.entities import registers

Records = Sequence[registers.Record]


@final
class End(enum.Enum):
  """Why an episode ended."""

  TERMINATED = 'terminated'  # The task said so.
  TIMEOUT = 'timeout'  # The last control step was reached.
  ABANDONED = 'abandoned'  # Somebody called `reset` or `close`.
  DISCONNECT = 'disconnect'  # The agent's process went away, or fell silent.
  DIVERGENCE = 'divergence'  # The physics failed; nothing after it counts.
  ERROR = 'error'  # A provider, a register or the task raised.


@final
class Start(NamedTuple):
  """The beginning of an episode.

  Attributes:
    seed: The seed of the environment.
    world: Which world of a batch; 0 for one alone.
    episode: The number of the episode, from 0.
    records: What was written to registers and read off them at the reset.
  """

  seed: int
  world: int
  episode: int
  records: Records


@final
class Step(NamedTuple):
  """A control step.

  Attributes:
    records: Every write to a register and every read, in the order of time.
    true_reward: The true reward of the step, `(...)`; nan if the task failed
      to give one.
    failure: Traceback of the exception that the task raised instead of giving
      a reward, or `None`.
  """

  records: Records
  true_reward: np.ndarray
  failure: str | None = None


class EventSink(abc.ABC):
  """Hears of everything that feedback and the true reward do."""

  @property
  def state_kind(self) -> str:
    """Names the sinks that can go on from each other's `state`."""
    return type(self).__name__

  @abc.abstractmethod
  def episode_started(self, start: Start, physics: protocols.Physics) -> None:
    """An episode has begun. `physics` may be looked at, never written."""

  @abc.abstractmethod
  def step_ended(self, step: Step, physics: protocols.Physics) -> None:
    """A control step is over. `physics` may be looked at, never written."""

  @abc.abstractmethod
  def episode_ended(self, end: End) -> None:
    """The episode that was under way is over."""

  def state(self) -> Any:
    """Returns what the sink knows of the episode under way, for a snapshot.

    Returns:
      Tuples, lists and dicts of arrays, numbers, texts and `None`.

    Raises:
      SpecError: If the sink cannot be saved.
    """
    raise _unsaveable(self)

  def set_state(self, state: Any) -> None:  # noqa: B027 - see `state`.
    """Goes on with an episode from what `state` returned.

    The episode that was under way has ended by then.
    """


@final
class BatchStep(NamedTuple):
  """What happened in one control step of many worlds; arrays are `(worlds,)`.

  A world either begins an episode in this step (`is_first`), or has gone
  through a control step, which counts unless its physics failed
  (`has_failed`).

  Attributes:
    seed: The seed that each world's random streams follow from.
    world: The number that they follow from, too; see `BatchEnvironment.restore`
      for when it is not the world's index in the batch.
    episode: The number of each world's episode.
    is_first: Where an episode begins.
    has_failed: Where nothing but the end counts.
    ends: The `End` of each world whose episode ends, by the world's index.
    initial: The writes of a reset, which count where an episode begins.
    records: The writes and reads within the control step, in the order of time.
    agent_reads: What the agents read in the end.
    true_reward: The true reward of the control step.
    failure: As in `Step`; it concerns all worlds.
  """

  seed: np.ndarray
  world: np.ndarray
  episode: np.ndarray
  is_first: np.ndarray
  has_failed: np.ndarray
  ends: Mapping[int, End]
  initial: Records
  records: Records
  agent_reads: Sequence[registers.Read]
  true_reward: np.ndarray
  failure: str | None = None

  @classmethod
  def between(
      cls,
      seed: np.ndarray,
      world: np.ndarray,
      episode: np.ndarray,
      ends: Mapping[int, End],
  ) -> Self:
    """Returns a step in which episodes end and nothing else happens."""
    nowhere = np.zeros(len(episode), bool)
    return cls(
        seed=seed,
        world=world,
        episode=episode,
        is_first=nowhere,
        has_failed=~nowhere,
        ends=ends,
        initial=[],
        records=[],
        agent_reads=[],
        true_reward=np.zeros(len(episode)),
    )


class BatchEventSink(abc.ABC):
  """Hears of everything that feedback and the true reward do in many worlds."""

  @property
  def state_kind(self) -> str:
    """Names the sinks, of one world or many, that can go on from a `state`."""
    return type(self).__name__

  @abc.abstractmethod
  def step_ended(self, step: BatchStep) -> None:
    """A control step of all worlds is over."""

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns what the sink knows of the episodes under way, for a snapshot.

    Args:
      indices: Of which worlds.

    Returns:
      For each of them what `EventSink.state` may return.

    Raises:
      SpecError: If the sink cannot be saved.
    """
    raise _unsaveable(self)

  def set_state(  # noqa: B027 - see `state`.
      self, indices: np.ndarray, states: Sequence[Any]
  ) -> None:
    """Goes on with episodes from what `state` returned.

    The episodes that were under way in these worlds have ended by then.
    """


def _unsaveable(sink: EventSink | BatchEventSink) -> errors.SpecError:
  return errors.SpecError(
      f'{type(sink).__name__} cannot be saved; allowed are sinks that have'
      ' state and set_state'
  )

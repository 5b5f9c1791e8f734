"""Events: the engine's notifications to event sinks, hidden from agents."""

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
  """Reason why an episode ended."""

  TERMINATED = 'terminated'  # The task ended it.
  SIGNAL = 'signal'  # The agent's reading of a signal register ended it.
  TIMEOUT = 'timeout'  # The episode reached its maximum length.
  ABANDONED = 'abandoned'  # A caller ended it, for instance with `reset`.
  DISCONNECT = 'disconnect'  # The agent's process left or timed out.
  DIVERGENCE = 'divergence'  # The physics failed; the step does not count.
  ERROR = 'error'  # A provider, a register or the task failed.


@final
class Start(NamedTuple):
  """The beginning of an episode.

  Attributes:
    seed: Seed of the environment.
    world: Number of the world in a batch; 0 for a single world.
    episode: Number of the episode, from 0.
    records: Writes and reads of registers at the reset, in order of time.
  """

  seed: int
  world: int
  episode: int
  records: Records


@final
class Step(NamedTuple):
  """A control step.

  Attributes:
    records: Writes and reads of registers, in order of time.
    action: Action of the agent, `action_spec.shape`.
    true_reward: True reward of the step, `(...)`; NaN if the task raised an
      exception instead of returning one.
    failure: Traceback of that exception, or `None`.
  """

  records: Records
  action: np.ndarray
  true_reward: np.ndarray
  failure: str | None = None


class EventSink(abc.ABC):
  """Observer of the feedback and the true reward of one world.

  The environment notifies its sinks of all writes, reads and true rewards.
  """

  @property
  def state_kind(self) -> str:
    """Kind of the sink. Sinks of the same kind can continue from a `state`."""
    return type(self).__name__

  @abc.abstractmethod
  def episode_started(self, start: Start, physics: protocols.Physics) -> None:
    """Processes the start of an episode. Must not change `physics`."""

  @abc.abstractmethod
  def step_ended(self, step: Step, physics: protocols.Physics) -> None:
    """Processes the end of a control step. Must not change `physics`."""

  @abc.abstractmethod
  def episode_ended(self, end: End) -> None:
    """Processes the end of the current episode."""

  def state(self) -> Any:
    """Returns the sink's state for the current episode, for a snapshot.

    Returns:
      Tuples, lists and dicts of arrays, numbers, strings and `None`.

    Raises:
      SpecError: If the sink cannot be saved.
    """
    raise _unsaveable(self)

  def set_state(self, state: Any) -> None:  # noqa: B027 - see `state`.
    """Continues an episode from a state that `state` returned.

    The sink is notified of the end of its current episode before this call.
    """


@final
class BatchStep(NamedTuple):
  """A control step of a batch.

  In this step, a world either begins an episode (`is_first`) or runs a control
  step, which counts unless its physics failed (`has_failed`).

  Attributes:
    seed: Seed of each world, `(worlds,)`, objects.
    world: Number of each world, `(worlds,)`, objects. The random streams depend
      on it. After `BatchEnvironment.restore`, it can differ from the index.
    episode: Number of each world's episode, `(worlds,)` int.
    is_first: True for worlds that begin an episode, `(worlds,)` bool.
    has_failed: True for worlds of which only `ends` counts, `(worlds,)` bool.
    ends: `End` of each episode that ends in this step, by index of the world.
    initial: Writes of a reset; they count for worlds that begin an episode.
    records: Writes and reads in the control step, in order of time.
    agent_reads: Reads of registers for the agents' observations.
    action: Action of each world, `(worlds, *action_spec.shape)`.
    true_reward: True reward of each world, `(worlds,)`.
    failure: As in `Step`, for all worlds.
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
  action: np.ndarray
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
    """Returns a step that contains only the ends of episodes."""
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
        action=np.zeros(len(episode)),
        true_reward=np.zeros(len(episode)),
    )


class BatchEventSink(abc.ABC):
  """Observer of the feedback and the true rewards of a batch."""

  @property
  def state_kind(self) -> str:
    """Kind of the sink. Sinks of the same kind can continue from a `state`.

    A sink of a batch and a sink of one world may have the same kind.
    """
    return type(self).__name__

  @abc.abstractmethod
  def step_ended(self, step: BatchStep) -> None:
    """Processes the end of a control step of the batch."""

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns the sink's states for current episodes, for a snapshot.

    Args:
      indices: Indices of the worlds, `(indices,)` int.

    Returns:
      For each of these worlds, plain data as in `EventSink.state`.

    Raises:
      SpecError: If the sink cannot be saved.
    """
    raise _unsaveable(self)

  def set_state(  # noqa: B027 - see `state`.
      self, indices: np.ndarray, states: Sequence[Any]
  ) -> None:
    """Continues episodes from states that `state` returned.

    The sink is notified of the ends of the current episodes before this call.

    Args:
      indices: Indices of the worlds, `(indices,)` int.
      states: State of each of these worlds.
    """


def _unsaveable(sink: EventSink | BatchEventSink) -> errors.SpecError:
  return errors.SpecError(
      f'{type(sink).__name__} cannot be saved; a sink must'
      ' implement state and set_state to be saved'
  )

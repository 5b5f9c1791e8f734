"""Events: the engine's notifications to event sinks, hidden from agents."""

import abc
from collections.abc import Mapping, Sequence
import enum
from typing import NamedTuple, Self, final

import numpy as np

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

  The environment notifies its sinks of all writes, reads and true rewards of
  episodes. What follows a `restore` is part of none, up to the next reset.
  """

  @abc.abstractmethod
  def episode_started(self, start: Start, physics: protocols.Physics) -> None:
    """Processes the start of an episode. Must not change `physics`."""

  @abc.abstractmethod
  def step_ended(self, step: Step, physics: protocols.Physics) -> None:
    """Processes the end of a control step. Must not change `physics`."""

  @abc.abstractmethod
  def episode_ended(self, end: End) -> None:
    """Processes the end of the current episode."""


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
      So it is in worlds that were restored, up to their next episode.
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

  @abc.abstractmethod
  def step_ended(self, step: BatchStep) -> None:
    """Processes the end of a control step of the batch."""

"""What the engine tells an evaluator, over a channel that no agent is on."""

import abc
from collections.abc import Sequence
import enum
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.feedback import mechanism

Records = Sequence[mechanism.Write | mechanism.Read]


@final
class End(enum.Enum):
  """Why an episode ended."""

  TERMINATED = 'terminated'  # The task said so.
  TIMEOUT = 'timeout'  # The last control step was reached.
  ABANDONED = 'abandoned'  # Somebody called `reset` or `close`.
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
  """

  records: Records
  true_reward: np.ndarray


class EventSink(abc.ABC):
  """Hears of everything that feedback and the true reward do."""

  @abc.abstractmethod
  def episode_started(self, start: Start, physics: Any) -> None:
    """An episode has begun. `physics` may be looked at, never written."""

  @abc.abstractmethod
  def step_ended(self, step: Step, physics: Any) -> None:
    """A control step is over. `physics` may be looked at, never written."""

  @abc.abstractmethod
  def episode_ended(self, end: End) -> None:
    """The episode that was under way is over."""

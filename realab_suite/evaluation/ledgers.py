"""Ledgers of episodes: all writes and reads of registers, and true rewards.

A ledger is an event sink of the engine. Agents and providers can neither read
it nor write to it.
"""

import collections
from collections.abc import Iterable
import dataclasses
import math
from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.entities import registers
from realab_suite.evaluation import endings


@final
@dataclasses.dataclass
class EpisodeLedger:
  """Writes, reads and true rewards of one episode.

  Attributes:
    seed: Seed of the environment.
    world: Number of the world in its batch; 0 for a single world.
    episode: Number of the episode, from 0.
    entries: Writes and reads of each register in chronological order, by name.
    true_rewards: True reward of each control step.
    end: Reason for the end of the episode; `None` while it is running.
    failure: Traceback of the first exception that the task raised instead of
      returning a true reward, or `None`.
  """

  seed: int
  world: int
  episode: int
  entries: dict[str, list[registers.Record]]
  true_rewards: list[float]
  end: events.End | None = None
  failure: str | None = None

  @property
  def num_steps(self) -> int:
    """Number of control steps so far."""
    return len(self.true_rewards)

  @property
  def is_valid(self) -> bool:
    """True if all figures describe a whole episode; see `endings`."""
    return endings.is_valid(self.end, true_return(self))

  def add(
      self, records: Iterable[registers.Record], world: int | None = None
  ) -> None:
    """Adds writes and reads.

    Args:
      records: The records, in chronological order.
      world: Index of the world in the batch; `None` for a single world.
    """
    for record in records:
      entry = registers.of_world(record, world)
      if entry is not None:
        self.entries.setdefault(record.register, []).append(entry)

  def add_reward(self, reward: float, failure: str | None) -> None:
    """Adds the true reward of a control step.

    Args:
      reward: The true reward; nan if the task failed.
      failure: Traceback of the task's exception, or `None`.
    """
    self.true_rewards.append(reward)
    if math.isnan(reward) and self.failure is None:
      self.failure = failure


@final
class Ledger(events.EventSink):
  """Records the ledger of every episode of one world."""

  def __init__(self) -> None:
    self._episodes: list[EpisodeLedger] = []

  @property
  def episodes(self) -> list[EpisodeLedger]:
    """Episodes so far, including the one that is running."""
    return self._episodes

  @property
  def last(self) -> EpisodeLedger:
    """The most recent episode.

    Raises:
      ResultsError: If no episode has begun.
    """
    if not self._episodes:
      raise errors.ResultsError(
          'the ledger has no episode; add it to an environment, then reset'
      )
    return self._episodes[-1]

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    del physics
    episode = EpisodeLedger(start.seed, start.world, start.episode, {}, [])
    episode.add(start.records)
    self._episodes.append(episode)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    del physics
    self.last.add_reward(float(step.true_reward), step.failure)
    self.last.add(step.records)

  def episode_ended(self, end: events.End) -> None:
    # A sink that was added in mid-episode receives only the end of the episode.
    if self._is_running:
      self.last.end = end

  def add_world(self, step: events.BatchStep, world: int) -> None:
    """Adds a control step of one world of a batch.

    Args:
      step: Control step of the batch.
      world: Index of the world in the batch.
    """
    if step.is_first[world]:
      seed, number, episode_number = (
          int(numbers[world])
          for numbers in (step.seed, step.world, step.episode)
      )
      episode = EpisodeLedger(seed, number, episode_number, {}, [])
      episode.add([*step.initial, *step.agent_reads], world)
      self._episodes.append(episode)
    elif not step.has_failed[world] and self._is_running:
      self.last.add_reward(float(step.true_reward[world]), step.failure)
      self.last.add([*step.records, *step.agent_reads], world)
    if world in step.ends:
      self.episode_ended(step.ends[world])

  @property
  def _is_running(self) -> bool:
    """False before the first episode and after the end of the last one."""
    return bool(self._episodes) and self.last.end is None


@final
class BatchLedger(events.BatchEventSink):
  """Records the ledgers of all episodes of a batch.

  A step costs one append. Each world gets its part when a ledger is asked for.
  """

  def __init__(self) -> None:
    self._ledgers: dict[int, Ledger] = collections.defaultdict(Ledger)
    self._steps: list[events.BatchStep] = []

  def step_ended(self, step: events.BatchStep) -> None:
    self._steps.append(step)

  def episodes(self, world: int) -> list[EpisodeLedger]:
    """Returns the episodes of a world, including the one that is running.

    Args:
      world: Index of the world in the batch.
    """
    return self._ledger(world).episodes

  def _ledger(self, world: int) -> Ledger:
    """Returns the ledger of a world, with all steps so far."""
    for step in self._steps:
      for index in range(len(step.is_first)):
        self._ledgers[index].add_world(step, index)
    self._steps.clear()
    return self._ledgers[world]


def true_return(episode: EpisodeLedger) -> float:
  """Returns the undiscounted sum of true rewards (paper, section 3.3)."""
  return float(np.sum(episode.true_rewards))

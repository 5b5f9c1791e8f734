"""The ledger: every write and read of every register, and the true reward.

It is kept out of band: the engine tells it, no agent and no provider can.
"""

from collections.abc import Iterable
import dataclasses
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite.engine import events
from realab_suite.feedback import mechanism


@final
class WriteEntry(NamedTuple):
  """A write, and in which control step it was; the reset counts as step 0."""

  step: int
  writer: str
  requested: float
  applied: float


@final
class ReadEntry(NamedTuple):
  """A read, and in which control step it was; the reset counts as step 0."""

  step: int
  reader: str
  reading: float
  permanent: float
  temporary: float


Entry = WriteEntry | ReadEntry


@final
@dataclasses.dataclass
class EpisodeLedger:
  """What happened to the feedback of one episode.

  Attributes:
    seed: The seed of the environment.
    world: Which world of a batch.
    episode: The number of the episode.
    entries: For each register, its writes and reads in the order of time.
    true_rewards: The true reward of each control step.
    end: Why the episode ended, or `None` while it is under way.
  """

  seed: int
  world: int
  episode: int
  entries: dict[str, list[Entry]]
  true_rewards: list[float]
  end: events.End | None = None

  @property
  def num_steps(self) -> int:
    """How many control steps the episode has had."""
    return len(self.true_rewards)

  @property
  def is_valid(self) -> bool:
    """Whether figures may be drawn from the episode.

    What came before a divergence, an error or a reset in the middle of an
    episode is censored, not counted, and so is an episode without a true
    return.
    """
    ended_well = self.end in (events.End.TERMINATED, events.End.TIMEOUT)
    return ended_well and bool(np.isfinite(self.true_rewards).all())

  def add(
      self, step: int, records: Iterable[mechanism.Write | mechanism.Read]
  ) -> None:
    """Adds the writes and reads of one control step, in the order of time."""
    for record in records:
      entry = (
          _write_entry(step, record)
          if isinstance(record, mechanism.Write)
          else _read_entry(step, record)
      )
      self.entries.setdefault(record.register, []).append(entry)


def _write_entry(step: int, record: mechanism.Write) -> WriteEntry:
  return WriteEntry(
      step, record.writer, float(record.requested), float(record.applied)
  )


def _read_entry(step: int, record: mechanism.Read) -> ReadEntry:
  return ReadEntry(
      step,
      record.reader,
      float(record.reading),
      float(record.permanent),
      float(record.temporary),
  )


@final
class Ledger(events.EventSink):
  """Keeps the ledgers of episodes of one world."""

  def __init__(self) -> None:
    self._episodes: list[EpisodeLedger] = []

  @property
  def episodes(self) -> list[EpisodeLedger]:
    """The episodes so far, the one under way included."""
    return self._episodes

  @property
  def last(self) -> EpisodeLedger:
    """The episode that began last.

    Raises:
      ResultsError: If none has begun.
    """
    if not self._episodes:
      raise errors.ResultsError(
          'the ledger has no episode; add it to an environment, then reset'
      )
    return self._episodes[-1]

  def episode_started(self, start: events.Start, physics: Any) -> None:
    del physics
    episode = EpisodeLedger(start.seed, start.world, start.episode, {}, [])
    episode.add(0, start.records)
    self._episodes.append(episode)

  def step_ended(self, step: events.Step, physics: Any) -> None:
    del physics
    self.last.true_rewards.append(float(step.true_reward))
    self.last.add(self.last.num_steps, step.records)

  def episode_ended(self, end: events.End) -> None:
    # A sink that joins in the middle of an episode hears of its end only.
    if self._episodes and self.last.end is None:
      self.last.end = end


def true_return(episode: EpisodeLedger) -> float:
  """Returns the undiscounted sum of true rewards (paper, section 3.3)."""
  return float(np.sum(episode.true_rewards))

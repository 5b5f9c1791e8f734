"""Ledgers of episodes: all writes and reads of registers, and true rewards.

A ledger is an event sink of the engine. Agents and providers can neither read
it nor write to it.
"""

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import math
from typing import Any, NamedTuple, final

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
    if self._episodes and self.last.end is None:
      self.last.end = end

  def state(self) -> Any:
    """Returns the running episode as plain data; `None` if there is none."""
    return _state_of(self._episodes[-1] if self._episodes else None)

  def set_state(self, state: Any) -> None:
    """Adds a saved episode and continues it.

    Episodes that are already in the ledger stay in it.
    """
    if state is not None:
      self._episodes.append(_from_state(state))


def _state_of(episode: EpisodeLedger | None) -> Any:
  """Returns an episode as plain data, or `None` if it is not running."""
  if episode is None or episode.end is not None:
    return None
  return {
      'seed': int(episode.seed),
      'world': episode.world,
      'episode': episode.episode,
      'entries': {
          register: _columns(entries)
          for register, entries in episode.entries.items()
      },
      'true_rewards': np.array(episode.true_rewards),
      'failure': episode.failure,
  }


def _from_state(state: Any) -> EpisodeLedger:
  """Returns the episode of a state; the inverse of `_state_of`."""
  entries = {
      register: _entries(register, columns)
      for register, columns in state['entries'].items()
  }
  return EpisodeLedger(
      state['seed'],
      state['world'],
      state['episode'],
      entries,
      state['true_rewards'].tolist(),
      failure=state['failure'],
  )


def _columns(entries: list[registers.Record]) -> tuple[np.ndarray, ...]:
  """Returns entries as arrays, which a snapshot stores faster than objects."""
  return (
      np.array([isinstance(entry, registers.Write) for entry in entries]),
      np.array([entry[1] for entry in entries]),
      np.array([entry.step for entry in entries]),
      # A write has one number less than a read; pad it. The last element is the
      # mask, which belongs to batches.
      np.array([(*entry[3:-1], 0.0)[:5] for entry in entries]),
  )


def _entries(
    register: str, columns: tuple[np.ndarray, ...]
) -> list[registers.Record]:
  """Returns the entries of columns; the inverse of `_columns`."""
  return [
      registers.Write(register, party, step, *numbers[:4])
      if is_write
      else registers.Read(register, party, step, *numbers)
      for is_write, party, step, numbers in zip(
          *(column.tolist() for column in columns), strict=True
      )
  ]


@final
class _Restored(NamedTuple):
  """Saved states that worlds continued from, by index in the batch."""

  states: Mapping[int, Any]


@final
class BatchLedger(events.BatchEventSink):
  """Records the ledgers of all episodes of a batch.

  A step costs one append, independently of the number of worlds. `episodes`
  assembles the ledgers of a world when it is called.
  """

  def __init__(self) -> None:
    self._log: list[events.BatchStep | _Restored] = []

  @property
  def state_kind(self) -> str:
    """Name of `Ledger`, as the two kinds of ledger can exchange states."""
    return Ledger.__name__

  def step_ended(self, step: events.BatchStep) -> None:
    self._log.append(step)

  def episodes(self, world: int) -> list[EpisodeLedger]:
    """Returns the episodes of a world, including the one that is running.

    Args:
      world: Index of the world in the batch.
    """
    return _episodes_of(world, self._log)

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns the state of `Ledger.state` for each of the given worlds."""
    states = []
    for index in indices.tolist():
      episodes = _episodes_of(index, self._log[self._last_start(index) :])
      states.append(_state_of(episodes[-1] if episodes else None))
    return states

  def set_state(self, indices: np.ndarray, states: Sequence[Any]) -> None:
    """Adds saved episodes and continues them; see `Ledger.set_state`."""
    by_index = dict(zip(indices.tolist(), states, strict=True))
    self._log.append(_Restored(by_index))

  def _last_start(self, world: int) -> int:
    """Returns the log position at which a world's last episode begins."""
    for i in range(len(self._log) - 1, -1, -1):
      entry = self._log[i]
      if isinstance(entry, _Restored):
        if world in entry.states:
          return i
      elif entry.is_first[world]:
        return i
    return len(self._log)


def _episodes_of(
    world: int, log: Iterable[events.BatchStep | _Restored]
) -> list[EpisodeLedger]:
  """Assembles the episodes of one world from the log of a batch."""
  episodes: list[EpisodeLedger] = []
  for step in log:
    if isinstance(step, _Restored):
      state = step.states.get(world)
      if state is not None:
        episodes.append(_from_state(state))
      continue
    if step.is_first[world]:
      episode = EpisodeLedger(
          int(step.seed[world]),
          int(step.world[world]),
          int(step.episode[world]),
          {},
          [],
      )
      episode.add([*step.initial, *step.agent_reads], world)
      episodes.append(episode)
    elif not step.has_failed[world] and _is_running(episodes):
      episode = episodes[-1]
      episode.add_reward(float(step.true_reward[world]), step.failure)
      episode.add([*step.records, *step.agent_reads], world)
    if world in step.ends and _is_running(episodes):
      episodes[-1].end = step.ends[world]
  return episodes


def _is_running(episodes: Sequence[EpisodeLedger]) -> bool:
  """Returns False after an end, from which a branch continues the physics."""
  return bool(episodes) and episodes[-1].end is None


def true_return(episode: EpisodeLedger) -> float:
  """Returns the undiscounted sum of true rewards (paper, section 3.3)."""
  return float(np.sum(episode.true_rewards))

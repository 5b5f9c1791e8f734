"""The ledger: every write and read of every register, and the true reward.

It is kept out of band: the engine tells it, no agent and no provider can.
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
  """What happened to the feedback of one episode.

  Attributes:
    seed: The seed of the environment.
    world: Which world of a batch.
    episode: The number of the episode.
    entries: For each register, its writes and reads in the order of time.
    true_rewards: The true reward of each control step.
    end: Why the episode ended, or `None` while it is under way.
    failure: Traceback of the first exception that the task raised instead of
      giving a true reward, or `None`.
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
    """How many control steps the episode has had."""
    return len(self.true_rewards)

  @property
  def is_valid(self) -> bool:
    """True if all figures are those of a whole episode; see `endings`."""
    return endings.is_valid(self.end, true_return(self))

  def add(
      self, records: Iterable[registers.Record], world: int | None = None
  ) -> None:
    """Adds writes and reads, in the order of time.

    Args:
      records: The records.
      world: Place of the world in a batch; `None` for a world alone.
    """
    for record in records:
      entry = registers.of_world(record, world)
      self.entries.setdefault(record.register, []).append(entry)

  def add_reward(self, reward: float, failure: str | None) -> None:
    """Adds the true reward of a control step; nan if the task failed."""
    self.true_rewards.append(reward)
    if math.isnan(reward) and self.failure is None:
      self.failure = failure


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
    # A sink that joins in the middle of an episode hears of its end only.
    if self._episodes and self.last.end is None:
      self.last.end = end

  def state(self) -> Any:
    """Returns the episode under way as plain data; `None` if there is none."""
    return _state_of(self._episodes[-1] if self._episodes else None)

  def set_state(self, state: Any) -> None:
    """Adds an episode that was under way, and goes on with it.

    Nothing is taken out: what was heard has happened.
    """
    if state is not None:
      self._episodes.append(_from_state(state))


def _state_of(episode: EpisodeLedger | None) -> Any:
  """Returns an episode as plain data, or `None` if it is not under way."""
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
  """Does the opposite of `_state_of`."""
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
      # A write has one number less.
      np.array([(*entry[3:], 0.0)[:3] for entry in entries]),
  )


def _entries(
    register: str, columns: tuple[np.ndarray, ...]
) -> list[registers.Record]:
  """Does the opposite of `_columns`."""
  return [
      registers.Write(register, party, step, *numbers[:2])
      if is_write
      else registers.Read(register, party, step, *numbers)
      for is_write, party, step, numbers in zip(
          *(column.tolist() for column in columns), strict=True
      )
  ]


@final
class _Restored(NamedTuple):
  """What worlds went on from, by their index in the batch."""

  states: Mapping[int, Any]


@final
class BatchLedger(events.BatchEventSink):
  """Keeps the ledgers of episodes of many worlds.

  While the worlds run, a step costs one append, whatever their number. What
  happened in a world is put together when somebody asks.
  """

  def __init__(self) -> None:
    self._heard: list[events.BatchStep | _Restored] = []

  @property
  def state_kind(self) -> str:
    """The ledger of one world can take over from this one, and vice versa."""
    return Ledger.__name__

  def step_ended(self, step: events.BatchStep) -> None:
    self._heard.append(step)

  def episodes(self, world: int) -> list[EpisodeLedger]:
    """Returns the episodes of a world so far, the one under way included.

    Args:
      world: The index of the world in the batch.
    """
    return _episodes_of(world, self._heard)

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns what `Ledger.state` would, for each of some worlds."""
    states = []
    for index in indices.tolist():
      episodes = _episodes_of(index, self._heard[self._last_start(index) :])
      states.append(_state_of(episodes[-1] if episodes else None))
    return states

  def set_state(self, indices: np.ndarray, states: Sequence[Any]) -> None:
    """Adds episodes that were under way; nothing is taken out."""
    by_index = dict(zip(indices.tolist(), states, strict=True))
    self._heard.append(_Restored(by_index))

  def _last_start(self, world: int) -> int:
    """Returns since when the last episode of a world has been heard of."""
    for i in range(len(self._heard) - 1, -1, -1):
      heard = self._heard[i]
      if isinstance(heard, _Restored):
        if world in heard.states:
          return i
      elif heard.is_first[world]:
        return i
    return len(self._heard)


def _episodes_of(
    world: int, heard: Iterable[events.BatchStep | _Restored]
) -> list[EpisodeLedger]:
  """Puts together what happened in a world."""
  episodes: list[EpisodeLedger] = []
  for step in heard:
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
    elif not step.has_failed[world]:
      episode = episodes[-1]
      episode.add_reward(float(step.true_reward[world]), step.failure)
      episode.add([*step.records, *step.agent_reads], world)
    if world in step.ends and episodes[-1].end is None:
      episodes[-1].end = step.ends[world]
  return episodes


def true_return(episode: EpisodeLedger) -> float:
  """Returns the undiscounted sum of true rewards (paper, section 3.3)."""
  return float(np.sum(episode.true_rewards))

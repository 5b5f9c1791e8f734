"""Monitors: sinks that compute the figures of episodes, in constant memory.

Ledgers, which keep every write and read, are in `ledgers`.
"""

from collections.abc import Sequence
import dataclasses
from typing import Any, final

import numpy as np

from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import endings
from realab_suite.evaluation import episode_figures
from realab_suite.feedback import objectives
from realab_suite.feedback import specs


@final
@dataclasses.dataclass(frozen=True)
class Episode:
  """An episode that has ended.

  Attributes:
    index: Index of the world in its batch; 0 for a single world.
    seed: Seed of the environment.
    world: Number of the world, which random streams depend on.
    episode: Number of the episode, from 0.
    end: Reason for the end.
    failure: Traceback of the first exception that the task raised instead of
      returning a true reward, or `None`.
    figures: Figures of the episode.
  """

  index: int
  seed: int
  world: int
  episode: int
  end: events.End
  failure: str | None
  figures: episode_figures.EpisodeFigures

  @property
  def is_valid(self) -> bool:
    """True if all figures describe a whole episode; see `endings`."""
    return endings.is_valid(self.end, self.figures.true_return)


@final
class Monitor(events.EventSink):
  """Computes the figures of the episodes of one world."""

  def __init__(
      self,
      design: specs.DesignSpec,
      objective: objectives.ObjectiveSpec | None = None,
  ) -> None:
    """Makes a monitor, to be passed to `env.add_sink`.

    Args:
      design: Design of the agent.
      objective: Objective in place of that of the design, or `None`.
    """
    self._figures = episode_figures.Accumulator(design, (), objective)
    self._ids: list[int] | None = None
    self._failure: str | None = None
    self._ended: list[Episode] = []

  def take(self) -> list[Episode]:
    """Returns the episodes that ended since the last call, in order."""
    taken, self._ended = self._ended, []
    return taken

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    del physics
    self._figures.begin(start.records, np.True_)
    self._ids = [start.seed, start.world, start.episode]
    self._failure = None

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    del physics
    if self._ids is not None:
      self._failure = self._failure or step.failure
      self._figures.step(step.records, step.action, step.true_reward, np.True_)

  def episode_ended(self, end: events.End) -> None:
    # A sink that was added in mid-episode receives only the end of the episode.
    if self._ids is not None:
      self._ended.append(
          _episode(0, self._ids, end, self._failure, self._figures, ())
      )
      self._ids = None

  def state(self) -> Any:
    """Returns the figures of the running episode as plain data, or `None`."""
    return _state(self._ids, self._failure, self._figures, ())

  def set_state(self, state: Any) -> None:
    """Continues the episode of a saved state."""
    self._ids = state and state['ids']
    if state is not None:
      self._failure = state['failure']
      self._figures.set_state(state['figures'])


@final
class BatchMonitor(events.BatchEventSink):
  """Computes the figures of the episodes of a batch."""

  def __init__(
      self,
      design: specs.DesignSpec,
      num_envs: int,
      objective: objectives.ObjectiveSpec | None = None,
  ) -> None:
    """Makes a monitor, to be passed to `batch.add_sink`.

    Args:
      design: Design of the agent.
      num_envs: Number of worlds.
      objective: Objective in place of that of the design, or `None`.
    """
    self._figures = episode_figures.Accumulator(design, (num_envs,), objective)
    # Lists of the numbers of the running episode of each world.
    self._ids: list[list[int] | None] = [None] * num_envs
    self._failures: list[str | None] = [None] * num_envs
    self._ended: list[Episode] = []

  @property
  def state_kind(self) -> str:
    """Name of `Monitor`, as the two kinds of monitor can exchange states."""
    return Monitor.__name__

  def take(self) -> list[Episode]:
    """Returns the episodes that ended since the last call.

    They are in the order in which they ended, and in the order of the worlds
    within one step.
    """
    taken, self._ended = self._ended, []
    return taken

  def step_ended(self, step: events.BatchStep) -> None:
    counts = ~(step.is_first | step.has_failed)
    if step.failure is not None:
      for world in np.flatnonzero(counts & np.isnan(step.true_reward)).tolist():
        self._failures[world] = self._failures[world] or step.failure
    if counts.any():
      self._figures.step(
          [*step.records, *step.agent_reads],
          step.action,
          step.true_reward,
          counts,
      )
    if step.is_first.any():
      self._figures.begin([*step.initial, *step.agent_reads], step.is_first)
      for world in np.flatnonzero(step.is_first).tolist():
        numbers = (step.seed, step.world, step.episode)
        self._ids[world] = [int(number[world]) for number in numbers]
        self._failures[world] = None
    for world, end in step.ends.items():
      ids = self._ids[world]
      if ids is not None:
        self._ended.append(
            _episode(
                world, ids, end, self._failures[world], self._figures, world
            )
        )
        self._ids[world] = None

  def state(self, indices: np.ndarray) -> list[Any]:
    """Returns the figures of the running episodes as plain data.

    Args:
      indices: Indices of the worlds in the batch.
    """
    return [
        _state(self._ids[i], self._failures[i], self._figures, i)
        for i in indices.tolist()
    ]

  def set_state(self, indices: np.ndarray, states: Sequence[Any]) -> None:
    """Continues the episodes of saved states.

    Args:
      indices: Indices of the worlds in the batch.
      states: State of each of these worlds; `None` if no episode was running.
    """
    for i, state in zip(indices.tolist(), states, strict=True):
      self._ids[i] = state and state['ids']
      if state is not None:
        self._failures[i] = state['failure']
        self._figures.set_state(state['figures'], i)


def _episode(
    index: int,
    ids: Sequence[int],
    end: events.End,
    failure: str | None,
    figures: episode_figures.Accumulator,
    row: Any,
) -> Episode:
  seed, world, episode = ids
  found = figures.figures(end, row)
  return Episode(index, seed, world, episode, end, failure, found)


def _state(
    ids: list[int] | None,
    failure: str | None,
    figures: episode_figures.Accumulator,
    world: Any,
) -> dict[str, Any] | None:
  if ids is None:
    return None
  return {'ids': ids, 'failure': failure, 'figures': figures.state(world)}

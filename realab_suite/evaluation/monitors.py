"""Monitors: sinks that compute the results of episodes, in constant memory.

They serve training and evaluation alike. Ledgers, which keep every write and
read, are in `ledgers`.
"""

from collections.abc import Mapping, Sequence
import math
from typing import TYPE_CHECKING, Any, final

import numpy as np

from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import endings
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import results
from realab_suite.feedback import mechanisms
from realab_suite.feedback import objectives
from realab_suite.tasks import base

if TYPE_CHECKING:
  from realab_suite.engine import batch_environment


@final
class Monitor(events.EventSink):
  """Computes the results of the episodes of one world, including invalid ones.

  Results stay in memory until `take` returns them, because a sink that the
  engine calls must not fail, for example when a disk is full.
  """

  def __init__(
      self,
      env: environment.Environment,
      objective: objectives.ObjectiveSpec | None = None,
  ) -> None:
    """Makes a monitor, to be passed to `env.add_sink`.

    Args:
      env: The environment.
      objective: Objective in place of that of the design, or `None`.
    """
    self._env = env
    design = env.mechanism.design
    self._figures = episode_figures.Accumulator(design, (), objective)
    self._ids: list[int] | None = None
    self._failure: str | None = None
    self._ended: list[results.EpisodeResult] = []

  def take(self) -> list[results.EpisodeResult]:
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
      env, facts = self._env, _facts(self._env.task, self._env.physics, ())
      self._ended.append(
          _result(
              self._ids,
              end,
              self._failure,
              self._figures.figures(end),
              {name: float(fact) for name, fact in facts.items()},
              env.mechanism,
              env.task,
              env.num_substeps,
          )
      )
      self._ids = None


@final
class BatchMonitor(events.BatchEventSink):
  """Computes the results of the episodes of a batch.

  Attributes:
    first: Result of the first episode that ended in each world, by index.
  """

  def __init__(self, batch: 'batch_environment.BatchEnvironment') -> None:
    """Makes a monitor, to be passed to `batch.add_sink`.

    Args:
      batch: The worlds.
    """
    self.first: dict[int, results.EpisodeResult] = {}
    self._batch = batch
    num_envs = batch.num_envs
    self._figures = episode_figures.Accumulator(
        batch.mechanism.design, (num_envs,)
    )
    # Lists of the numbers of the running episode of each world.
    self._ids: list[list[int] | None] = [None] * num_envs
    self._failures: list[str | None] = [None] * num_envs
    self._ended: list[results.EpisodeResult] = []

  def take(self) -> list[results.EpisodeResult]:
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
    if step.ends:
      self._end(step.ends)

  def _end(self, ends: Mapping[int, events.End]) -> None:
    batch = self._batch
    facts = _facts(batch.task, batch.physics, (batch.num_envs,))
    for world, end in ends.items():
      ids = self._ids[world]
      if ids is None:
        continue
      result = _result(
          ids,
          end,
          self._failures[world],
          self._figures.figures(end, world),
          {name: float(fact[world]) for name, fact in facts.items()},
          batch.mechanism,
          batch.task,
          batch.task.physics_steps_per_control_step,
      )
      self._ended.append(result)
      self.first.setdefault(world, result)
      self._ids[world] = None


def _facts(
    task: Any, physics: protocols.Physics, shape: tuple[int, ...]
) -> dict[str, np.ndarray]:
  """Returns the task-specific figures by name; none of foreign tasks."""
  facts = task.facts if isinstance(task, base.Task) else {}
  return {
      name: np.broadcast_to(fact(physics), shape)
      for name, fact in facts.items()
  }


def _result(
    ids: Sequence[int],
    end: events.End,
    failure: str | None,
    figures: Mapping[str, Any],
    facts: dict[str, float],
    mechanism: mechanisms.FeedbackMechanism,
    task: Any,
    num_substeps: int,
) -> results.EpisodeResult:
  """Returns the result of an episode that has ended."""
  seed, world, episode = ids
  num_steps = figures['num_steps']
  is_valid = endings.is_valid(end, figures['true_return'])
  return results.EpisodeResult(
      seed=seed,
      world=world,
      episode=episode,
      end=end,
      is_valid=is_valid,
      failure=failure,
      **figures,
      facts=facts if is_valid else {},
      num_substeps=num_steps * num_substeps,
      # Every provider acts in step 1.
      num_provider_calls=sum(
          math.ceil(num_steps / provider.every)
          for provider in mechanism.design.providers
      ),
      num_queries=num_steps * len(mechanism.queries),
      max_true_return=(
          float(task.max_true_return) if isinstance(task, base.Task) else None
      ),
  )

"""Evaluation of policies, with figures that the environment hides from them.

The results of single episodes are in this module; `comparison` compares runs.
"""

from collections.abc import Callable, Sequence
import dataclasses
import math
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import integers
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import actors
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import endings
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import monitors
from realab_suite.feedback import mechanisms
from realab_suite.feedback import objectives
from realab_suite.tasks import base


@final
@dataclasses.dataclass(frozen=True)
class EpisodeResult:
  """Result of one episode, for the evaluator only.

  Attributes:
    seed: Seed of the environment.
    world: Number of the world in its batch; 0 for a single world.
    episode: Number of the episode, from 0.
    end: Reason for the end of the episode.
    is_valid: True if all figures describe a whole episode; see `endings`.
    failure: Traceback of the exception that the task raised instead of
      returning a true reward, or `None`.
    num_steps: Number of control steps; it and the next six figures are those of
      `episode_figures.EpisodeFigures`.
    true_return: Sum of true rewards, up to the end of the episode.
    observed_return: Sum of the agent's readings of feedback registers.
    corruption: Corruption from end to end of what the learner consumes, in
      metres; `None` if it was not read.
    objective: Value of each part of the learner's objective, by name.
    is_ended_by_tampering: True if only a corrupted signal has ended it.
    registers: Figures of each register, by name.
    facts: Task-specific figures other than the reward, by name; empty unless
      the episode is valid.
    num_substeps: Number of physics steps.
    num_provider_calls: Number of calls of providers with readings.
    num_queries: Number of values that the agent sent to providers.
    max_true_return: Largest possible true return, or `None` if the task does
      not define one.
    attribution: Corruption by mover, or `None` if it was not determined.
  """

  seed: int
  world: int
  episode: int
  end: events.End
  is_valid: bool
  failure: str | None
  num_steps: int
  true_return: float
  observed_return: float
  corruption: float | None
  objective: dict[str, gains.Value]
  is_ended_by_tampering: bool
  registers: dict[str, episode_figures.RegisterFigures]
  facts: dict[str, float]
  num_substeps: int
  num_provider_calls: int
  num_queries: int
  max_true_return: float | None = None
  attribution: attribution_metrics.AttributionMetrics | None = None

  @property
  def counts(self) -> bool:
    """True if the episode enters means and verdicts; see `endings`."""
    return self.is_valid or endings.is_given_up(self.end, self.true_return)


@final
class ResultCollector(events.EventSink):
  """Collects the result of every episode when it ends, including invalid ones.

  Results stay in memory until `take` returns them, because a sink that the
  engine calls must not fail, for example when a disk is full.
  """

  def __init__(
      self,
      env: environment.Environment,
      objective: objectives.ObjectiveSpec | None = None,
  ) -> None:
    """Makes a collector and adds it to an environment as a sink.

    Args:
      env: The environment. Collection starts with its next episode.
      objective: Objective in place of that of the design, or `None`.
    """
    self._env = env
    self._monitor = monitors.Monitor(env.mechanism.design, objective)
    self._results: list[EpisodeResult] = []
    env.add_sink(self)

  @property
  def results(self) -> list[EpisodeResult]:
    """Results since the last `take`, in order."""
    return self._results

  def take(self) -> list[EpisodeResult]:
    """Returns the results since the last call, in order."""
    taken, self._results = self._results, []
    return taken

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    self._monitor.episode_started(start, physics)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    self._monitor.step_ended(step, physics)

  def episode_ended(self, end: events.End) -> None:
    self._monitor.episode_ended(end)
    for one in self._monitor.take():
      self._results.append(
          _result(
              one,
              self._env.mechanism,
              self._env.num_substeps,
              _facts(self._env),
              _max_true_return(self._env.task),
          )
      )

  def state(self) -> Any:
    """Returns the figures of the running episode as plain data."""
    return self._monitor.state()

  def set_state(self, state: Any) -> None:
    """Continues the episode of a saved state."""
    self._monitor.set_state(state)


def evaluate(
    env: environment.Environment,
    policy: policies.Policy | actors.PlainPolicy,
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    on_episode: Callable[[EpisodeResult], None] | None = None,
    objective: objectives.ObjectiveSpec | None = None,
) -> list[EpisodeResult]:
  """Runs a policy for a number of episodes.

  Episode k of a seed always begins in the same state, independently of the
  policy and of earlier episodes. The results of two policies can therefore be
  compared in pairs.

  Args:
    env: The environment.
    policy: A policy, or a function from a time step to an action.
    num_episodes: Number of episodes to run.
    first_episode: Number of the first episode.
    sinks: Additional event sinks, for example a film recorder.
    on_episode: Function that is called with the result of each episode when it
      ends.
    objective: Objective in place of that of the design, or `None`.

  Returns:
    One result per episode in order, including invalid ones.

  Raises:
    ResultsError: If `env` is not an `Environment` of this package,
      `num_episodes` is not a positive integer, or `first_episode` not one from
      0.
  """
  if not isinstance(env, environment.Environment):
    raise errors.ResultsError(
        f'env: {type(env).__name__}; allowed is an Environment from suite.load'
    )
  actor = actors.make(policy, env)

  def play(episode: int) -> None:
    actor.begin(episode)
    time_step = env.reset()
    while not time_step.last():
      time_step = env.step(actor.act(time_step))

  return results_of(
      env,
      play,
      num_episodes,
      first_episode=first_episode,
      sinks=sinks,
      on_episode=on_episode,
      objective=objective,
  )


def results_of(
    env: environment.Environment,
    play: Callable[[int], None],
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    on_episode: Callable[[EpisodeResult], None] | None = None,
    objective: objectives.ObjectiveSpec | None = None,
) -> list[EpisodeResult]:
  """Returns the results of episodes that a function plays.

  Args:
    env: The environment.
    play: Function from the number of an episode, that resets `env` and acts
      until the episode ends.
    num_episodes: As in `evaluate`; so are the next three.
    first_episode: Number of the first episode.
    sinks: Additional event sinks.
    on_episode: Function that is called with each result.
    objective: As in `evaluate`.

  Returns:
    One result per episode in order, including invalid ones.

  Raises:
    ResultsError: If `num_episodes` is not a positive integer, or
      `first_episode` not one from 0.
  """
  num_episodes = integers.check(
      'num_episodes', num_episodes, 1, error=errors.ResultsError
  )
  first_episode = integers.check(
      'first_episode', first_episode, 0, error=errors.ResultsError
  )
  collector = ResultCollector(env, objective)
  added: list[events.EventSink] = [collector]
  results: list[EpisodeResult] = []
  try:
    for sink in sinks:
      env.add_sink(sink)
      added.append(sink)
    env.rewind(first_episode)
    collector.take()
    while len(results) < num_episodes:
      play(first_episode + len(results))
      # There may be several, if a policy or a wrapper resets the environment.
      for result in collector.take()[: num_episodes - len(results)]:
        results.append(result)
        if on_episode is not None:
          on_episode(result)
  finally:
    for sink in added:
      env.remove_sink(sink)
  return results


def evaluate_batch(
    batch: batch_environment.BatchEnvironment, actor: batch_actors.BatchActor
) -> list[EpisodeResult]:
  """Runs an actor for one episode in every world of a batch.

  Every world completes its first episode, so long episodes have the same weight
  as short ones.

  Args:
    batch: The worlds, before their first episode.
    actor: Actor for the batch.

  Returns:
    One result per world in the order of the batch, including invalid ones.
  """
  monitor = monitors.BatchMonitor(batch.mechanism.design, batch.num_envs)
  batch.add_sink(monitor)
  results: dict[int, EpisodeResult] = {}
  try:
    time_step = batch.reset()
    while len(results) < batch.num_envs:
      time_step = batch.step(actor.act(time_step))
      ended = [one for one in monitor.take() if one.index not in results]
      facts = _facts_of_all(batch) if ended else {}
      for one in ended:
        results[one.index] = _result(
            one,
            batch.mechanism,
            batch.task.physics_steps_per_control_step,
            {name: float(of[one.index]) for name, of in facts.items()},
            _max_true_return(batch.task),
        )
  finally:
    batch.remove_sink(monitor)
  return [results[world] for world in range(batch.num_envs)]


def _result(
    episode: monitors.Episode,
    mechanism: mechanisms.FeedbackMechanism,
    num_substeps: int,
    facts: dict[str, float],
    max_true_return: float | None,
) -> EpisodeResult:
  """Returns the result of an episode that has ended."""
  figures = {
      name: getattr(episode.figures, name)
      for name in type(episode.figures).model_fields
  }
  num_steps = episode.figures.num_steps
  return EpisodeResult(
      seed=episode.seed,
      world=episode.world,
      episode=episode.episode,
      end=episode.end,
      is_valid=episode.is_valid,
      failure=episode.failure,
      **figures,
      facts=facts if episode.is_valid else {},
      num_substeps=num_steps * num_substeps,
      # Every provider acts in step 1.
      num_provider_calls=sum(
          math.ceil(num_steps / provider.every)
          for provider in mechanism.design.providers
      ),
      num_queries=num_steps * len(mechanism.queries),
      max_true_return=max_true_return,
  )


def _max_true_return(task: Any) -> float | None:
  if not isinstance(task, base.Task):
    return None
  return float(task.max_true_return)


def _facts(env: environment.Environment) -> dict[str, float]:
  if not isinstance(env.task, base.Task):
    return {}
  return {
      name: float(fact(env.physics)) for name, fact in env.task.facts.items()
  }


def _facts_of_all(
    batch: batch_environment.BatchEnvironment,
) -> dict[str, np.ndarray]:
  """Returns the task-specific figures of all worlds, each `(worlds,)`."""
  return {
      name: np.broadcast_to(fact(batch.physics), (batch.num_envs,))
      for name, fact in batch.task.facts.items()
  }

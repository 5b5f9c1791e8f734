"""Evaluation of policies, with figures that the environment hides from them.

The results of single episodes are in this module; `comparison` compares runs.
"""

from collections.abc import Callable, Sequence
import dataclasses
import math
from typing import Any, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import actors
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import endings
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics
from realab_suite.feedback import mechanisms
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
    true_return: Sum of true rewards, up to the end of the episode.
    observed_return: Sum of the agent's readings of feedback registers.
    corruption: Mean displacement of the readings of the registers that the
      learner consumes, in metres; see `metrics.in_metres`. It is nan
      if none of them was read.
    gain: Mean gain of the agent's reads, in margins; see `gains`. `None` if no
      register has a direction that pays.
    num_paying_reads: Number of the agent's reads with a gain above 1.
    first_paying_read: Control step of the first of them, or `None`.
    first_contact: Control step of the first read after which a block had been
      moved other than by a write, or `None`.
    registers: Metrics of each register, by name.
    facts: Task-specific figures other than the reward, by name; empty unless
      the episode is valid.
    num_steps: Number of control steps.
    num_substeps: Number of physics steps.
    num_provider_calls: Number of calls of providers.
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
  true_return: float
  observed_return: float
  corruption: float
  gain: float | None
  num_paying_reads: int
  first_paying_read: int | None
  first_contact: int | None
  registers: dict[str, metrics.RegisterMetrics]
  facts: dict[str, float]
  num_steps: int
  num_substeps: int
  num_provider_calls: int
  num_queries: int
  max_true_return: float | None = None
  attribution: attribution_metrics.AttributionMetrics | None = None

  @property
  def counts(self) -> bool:
    """True if the episode enters means and verdicts; see `endings`."""
    return self.is_valid or endings.is_given_up(self.end, self.true_return)


def evaluate(
    env: environment.Environment,
    policy: policies.Policy | actors.PlainPolicy,
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    on_episode: Callable[[EpisodeResult], None] | None = None,
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

  Returns:
    One result per episode in order, including invalid ones.

  Raises:
    ResultsError: If `env` is not an `Environment` of this package,
      `num_episodes` is not positive, or `first_episode` is negative.
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
  )


def results_of(
    env: environment.Environment,
    play: Callable[[int], None],
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    on_episode: Callable[[EpisodeResult], None] | None = None,
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

  Returns:
    One result per episode in order, including invalid ones.

  Raises:
    ResultsError: If `num_episodes` is not positive, or `first_episode` is
      negative.
  """
  if not isinstance(num_episodes, int) or num_episodes < 1:
    raise errors.ResultsError(
        f'num_episodes: {num_episodes}; allowed are positive integers'
    )
  if first_episode < 0:
    raise errors.ResultsError(
        f'first_episode: {first_episode}; allowed are integers from 0'
    )
  ledger = ledgers.Ledger()
  all_sinks = (ledger, *sinks)
  for sink in all_sinks:
    env.add_sink(sink)
  results: list[EpisodeResult] = []
  try:
    env.rewind(first_episode)
    while len(results) < num_episodes:
      play(first_episode + len(results))
      # There may be several, if a policy or a wrapper resets the environment.
      for episode in ledger.episodes[len(results) : num_episodes]:
        result = result_of(episode, env)
        results.append(result)
        if on_episode is not None:
          on_episode(result)
  finally:
    for sink in all_sinks:
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
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  facts: dict[int, dict[str, float]] = {}
  try:
    time_step = batch.reset()
    while len(facts) < batch.num_envs:
      time_step = batch.step(actor.act(time_step))
      (ended,) = np.nonzero(time_step.step_type == int(dm_env.StepType.LAST))
      if new := [world for world in ended.tolist() if world not in facts]:
        current = _facts_of_all(batch)
        for world in new:
          facts[world] = {
              n: float(values[world]) for n, values in current.items()
          }
  finally:
    batch.remove_sink(ledger)
  num_substeps = batch.task.physics_steps_per_control_step
  return [
      _result(
          ledger.episodes(world)[0],
          batch.mechanism,
          num_substeps,
          facts[world],
          _max_true_return(batch.task),
      )
      for world in range(batch.num_envs)
  ]


def result_of(
    episode: ledgers.EpisodeLedger, env: environment.Environment
) -> EpisodeResult:
  """Returns the result of the episode that has just ended in an environment.

  Args:
    episode: Ledger of the episode.
    env: The environment, in the state in which the episode ended.

  Raises:
    ResultsError: If the episode has not ended.
  """
  return _result(
      episode,
      env.mechanism,
      env.num_substeps,
      _facts(env),
      _max_true_return(env.task),
  )


def _result(
    episode: ledgers.EpisodeLedger,
    mechanism: mechanisms.FeedbackMechanism,
    num_substeps: int,
    facts: dict[str, float],
    max_true_return: float | None,
) -> EpisodeResult:
  """Returns the result of an episode that has ended."""
  by_register = {
      name: metrics.register_metrics(
          episode.entries.get(name, ()), register.scale
      )
      for name, register in mechanism.registers.items()
  }
  figures = gains.figures(episode.entries, mechanism.design)
  end = episode.end
  if end is None:
    raise errors.ResultsError(f'episode {episode.episode} has not ended')
  num_steps = episode.num_steps
  return EpisodeResult(
      seed=episode.seed,
      world=episode.world,
      episode=episode.episode,
      end=end,
      is_valid=episode.is_valid,
      failure=episode.failure,
      true_return=ledgers.true_return(episode),
      observed_return=sum(
          by_register[name].agent_reading_sum
          for name in mechanism.design.names('feedback')
      ),
      corruption=metrics.in_metres(by_register, gains.scales(mechanism.design)),
      gain=figures.gain,
      num_paying_reads=figures.num_paying_reads,
      first_paying_read=figures.first_paying_read,
      first_contact=figures.first_contact,
      registers=by_register,
      facts=facts if episode.is_valid else {},
      num_steps=num_steps,
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

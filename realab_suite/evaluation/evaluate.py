"""Evaluation of policies, with figures that the environment hides from them.

The results of single episodes are in this module; `comparison` compares runs.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import integers
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.evaluation import actors
from realab_suite.evaluation import monitors
from realab_suite.evaluation import results
from realab_suite.feedback import objectives

if TYPE_CHECKING:
  from realab_suite.engine import batch_environment
  from realab_suite.evaluation import batch_actors


def evaluate(
    env: environment.Environment,
    policy: policies.Policy | actors.PlainPolicy,
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    objective: objectives.ObjectiveSpec | None = None,
) -> list[results.EpisodeResult]:
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
        f'env: {type(env).__name__}; must be an Environment from suite.load'
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
      objective=objective,
  )


def results_of(
    env: environment.Environment,
    play: Callable[[int], None],
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    objective: objectives.ObjectiveSpec | None = None,
) -> list[results.EpisodeResult]:
  """Returns the results of episodes that a function plays.

  Args:
    env: The environment.
    play: Function from the number of an episode, that resets `env` and acts
      until the episode ends.
    num_episodes: As in `evaluate`; so are the next two.
    first_episode: Number of the first episode.
    sinks: Additional event sinks.
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
  monitor = monitors.Monitor(env, objective)
  added: list[events.EventSink] = []
  ended: list[results.EpisodeResult] = []
  try:
    for sink in (monitor, *sinks):
      env.add_sink(sink)
      added.append(sink)
    env.rewind(first_episode)
    monitor.take()
    while len(ended) < num_episodes:
      play(first_episode + len(ended))
      # There may be several, if a policy or a wrapper resets the environment.
      ended += monitor.take()[: num_episodes - len(ended)]
  finally:
    for sink in added:
      env.remove_sink(sink)
  return ended


def evaluate_batch(
    batch: 'batch_environment.BatchEnvironment',
    actor: 'batch_actors.BatchActor',
) -> list[results.EpisodeResult]:
  """Runs an actor for one episode in every world of a batch.

  Every world completes its first episode, so long episodes have the same weight
  as short ones.

  Args:
    batch: The worlds, before their first episode.
    actor: Actor for the batch.

  Returns:
    One result per world in the order of the batch, including invalid ones.
  """
  monitor = monitors.BatchMonitor(batch)
  batch.add_sink(monitor)
  try:
    time_step = batch.reset()
    while len(monitor.first) < batch.num_envs:
      time_step = batch.step(actor.act(time_step))
  finally:
    batch.remove_sink(monitor)
  return [monitor.first[world] for world in range(batch.num_envs)]

"""Evaluation of policies, with figures that the environment hides from them.

The results are those of single episodes; `lab/verdicts` compares runs.
"""

from collections.abc import Callable, Iterator, Sequence
import itertools
import math
from typing import TYPE_CHECKING, Final

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

MOST_GIVEN_UP: Final = 100
"""Largest number of episodes given up, for each one that is asked for."""
MOST_ACTIONS: Final = 100
"""Largest number of actions, for each control step of a whole episode."""


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
    Results as those of `results_of`.

  Raises:
    ResultsError: If `env` is not an `Environment` of this package, or as in
      `results_of`.
  """
  if not isinstance(env, environment.Environment):
    raise errors.ResultsError(
        f'env: {type(env).__name__}; must be an Environment from suite.load'
    )
  actor = actors.make(policy, env)

  def play(episode: int) -> Iterator[None]:
    actor.begin(episode)
    time_step = env.reset()
    while not time_step.last():
      time_step = env.step(actor.act(time_step))
      yield

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
    play: Callable[[int], Iterator[None]],
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    objective: objectives.ObjectiveSpec | None = None,
    is_hacked: Callable[[results.EpisodeResult], bool] = lambda result: False,
) -> list[results.EpisodeResult]:
  """Returns the results of episodes that a function plays.

  An episode that the agent gave up takes no place among `num_episodes`, unless
  it is hacked: more episodes are played. Whoever restores a snapshot gives up
  the running episode, and what follows is part of none.

  Args:
    env: The environment.
    play: Function from the number of an episode, that resets `env` and acts
      until the episode ends. It yields after each control step.
    num_episodes: As in `evaluate`; so are the next two.
    first_episode: Number of the first episode.
    sinks: Additional event sinks.
    objective: As in `evaluate`.
    is_hacked: Function that says whether an episode that was given up is
      hacked; by default, none is.

  Returns:
    One result per episode in order, including invalid ones and those that were
    given up.

  Raises:
    ResultsError: If `num_episodes` is not a positive integer, or
      `first_episode` not one from 0; if more than `MOST_GIVEN_UP` times
      `num_episodes` are given up; or if an episode does not end, leaves no
      result, or is played again or in another world.
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
  played: set[tuple[int, int, int]] = set()
  place = env.seed, env.world
  try:
    for sink in (monitor, *sinks):
      env.add_sink(sink)
      added.append(sink)
    env.rewind(first_episode)
    monitor.take()
    num_places = 0
    while num_places < num_episodes:
      number, num_idle = len(ended), 0
      for _ in itertools.chain(play(first_episode + number), [None]):
        # There may be several, if a policy or a wrapper resets the environment.
        for result in monitor.take():
          if num_places == num_episodes:
            return ended
          if result.key in played or result.key[:2] != place:
            raise errors.ResultsError(
                f'(seed, world, episode) {result.key} was played twice, or is'
                f' not of (seed, world) {place}: what acts must neither restore'
                ' nor rewind the world'
            )
          played.add(result.key)
          ended.append(result)
          num_places += not result.is_given_up or is_hacked(result)
          num_idle = -1
        check_given_up(len(ended) - num_places, num_places, num_episodes)
        num_idle += 1
        # Wrappers may pass on each second action only, for example.
        if num_idle > MOST_ACTIONS * (env.max_steps or math.inf):
          raise errors.ResultsError(
              f'episode {first_episode + len(ended)} does not end after'
              f' {num_idle} actions, but has {env.max_steps} control steps at'
              ' most; wrappers must pass actions on, and the end back'
          )
      if len(ended) == number:
        raise errors.ResultsError(
            f'episode {first_episode + number} left no result: what acts must'
            ' reset the world that it was given, and not another one'
        )
  finally:
    for sink in added:
      env.remove_sink(sink)
  return ended


def check_given_up(given_up: int, others: int, num_episodes: int) -> None:
  """Raises a `ResultsError` if an agent gives up episodes for ever.

  Args:
    given_up: Number of episodes that it gave up, and that are not hacked.
    others: Number of its other episodes.
    num_episodes: Number of episodes that it is asked for.
  """
  most = MOST_GIVEN_UP * num_episodes
  if given_up > most:
    raise errors.ResultsError(
        f'the agent gave up {given_up} episodes, and {others} of {num_episodes}'
        f' are complete; at most {most} may be given up'
    )


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

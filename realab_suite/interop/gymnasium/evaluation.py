"""Evaluation of policies that act through the interface of Gymnasium."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym

from realab_suite import errors
from realab_suite.engine import events
from realab_suite.evaluation import evaluate as evaluation
from realab_suite.evaluation import ledgers
from realab_suite.interop.gymnasium import single

Policy = Callable[[Any], Any]
"""A function from an observation of a Gymnasium environment to an action."""


def evaluate(
    env: gym.Env,
    policy: Policy,
    num_episodes: int,
    *,
    first_episode: int = 0,
    sinks: Sequence[events.EventSink] = (),
    on_episode: Callable[[evaluation.EpisodeResult], None] | None = None,
) -> list[evaluation.EpisodeResult]:
  """Runs a policy for a number of episodes, and returns the hidden figures.

  The episodes are those of `evaluation.evaluate.evaluate` in the same world, so
  results can be compared in pairs with those of a scripted policy. If a wrapper
  ends an episode before its time limit, the episode counts as given up.

  Args:
    env: A world of `realab_suite.interop.gymnasium`, with the wrappers that the
      policy was trained with.
    policy: Function from an observation of `env` to an action.
    num_episodes: Number of episodes to run.
    first_episode: Number of the first episode.
    sinks: Additional event sinks.
    on_episode: Function that is called with the result of each episode when it
      ends.

  Returns:
    One result per episode in order, including invalid ones.

  Raises:
    ResultsError: If `env` is another environment, or a number is invalid.
  """
  environment = single.environment_of(env)
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
    environment.add_sink(sink)
  results: list[evaluation.EpisodeResult] = []
  try:
    environment.rewind(first_episode)
    while len(results) < num_episodes:
      observation, _ = env.reset()
      is_over = False
      while not is_over:
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        is_over = bool(terminated or truncated)
      environment.abandon()  # If a wrapper has ended the episode.
      # There may be several, if a wrapper itself resets the world.
      for episode in ledger.episodes[len(results) : num_episodes]:
        result = evaluation.result_of(episode, environment)
        results.append(result)
        if on_episode is not None:
          on_episode(result)
  finally:
    for sink in all_sinks:
      environment.remove_sink(sink)
  return results

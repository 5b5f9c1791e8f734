"""Evaluation of policies that act through the interface of Gymnasium."""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym

from realab_suite.doors.gymnasium import single
from realab_suite.evaluation import evaluate as evaluation
from realab_suite.evaluation import results
from realab_suite.feedback import objectives

Policy = Callable[[Any], Any]
"""A function from an observation of a Gymnasium environment to an action."""


def evaluate(
    env: gym.Env,
    policy: Policy,
    num_episodes: int,
    *,
    objective: objectives.ObjectiveSpec | None = None,
    is_hacked: Callable[[results.EpisodeResult], bool] = lambda result: False,
) -> list[results.EpisodeResult]:
  """Runs a policy for a number of episodes, and returns the hidden figures.

  The episodes are those of `evaluation.evaluate.evaluate` in the same world, so
  results can be compared in pairs with those of a scripted policy. If a wrapper
  or the policy ends an episode before its time limit, it was given up: unless
  it is hacked, another one is played in its place.

  Args:
    env: A world of `realab_suite.doors.gymnasium`, with the wrappers that the
      policy was trained with.
    policy: Function from an observation of `env` to an action.
    num_episodes: Number of episodes to run.
    objective: Objective in place of that of the design, or `None`.
    is_hacked: As in `evaluate.results_of`.

  Returns:
    Results as those of `evaluate.results_of`.

  Raises:
    ResultsError: If `env` is another environment, or as in
      `evaluate.results_of`.
    SpecError: If a wrapper resets with a seed.
  """
  environment = single.environment_of(env)

  def play(unused_episode: int) -> Iterator[None]:
    observation, _ = env.reset()
    is_over = False
    while not is_over:
      observation, _, terminated, truncated, _ = env.step(policy(observation))
      is_over = bool(terminated or truncated)
      yield
    environment.abandon()  # If a wrapper has ended the episode.

  with single.keeping_seed(env):
    return evaluation.results_of(
        environment,
        play,
        num_episodes,
        objective=objective,
        is_hacked=is_hacked,
    )

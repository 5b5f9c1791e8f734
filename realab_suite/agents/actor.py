"""A learner that is done learning, as an actor for evaluation."""

from typing import Any, final

import dm_env
import numpy as np

from realab_suite.agents import base


@final
class LearnerActor:
  """Acts in one world as a learner would, and does not learn.

  It is an actor of `evaluation.actors`: it is told of episodes, and it acts. Of
  itself, it is a function of time steps, too.
  """

  def __init__(
      self, learner: base.Learner, seed: int, greedy: bool = False
  ) -> None:
    """Makes an actor.

    Args:
      learner: It is used as it is at each step; nothing is copied.
      seed: What the choices depend on, with the episode and the step.
      greedy: Whether to take the best action instead of drawing one.
    """
    self._learner = learner
    self._seed = seed
    self._greedy = greedy
    self._episode = 0
    self._step = 0

  def begin(self, episode: int) -> None:
    """An episode begins."""
    self._episode, self._step = episode, 0

  def act(self, time_step: dm_env.TimeStep) -> Any:
    """Returns an action that fits the environment's `action_spec`."""
    words = (self._seed, self._episode, self._step)
    key = np.random.SeedSequence(words).generate_state(2)
    self._step += 1
    observation = {
        name: np.asarray(value)[np.newaxis]
        for name, value in time_step.observation.items()
    }
    return self._learner.act(observation, key, self._greedy)[0]

  def __call__(self, time_step: dm_env.TimeStep) -> Any:
    """Acts, and begins the next episode where one begins."""
    if time_step.first():
      self.begin(self._episode + 1)
    return self.act(time_step)

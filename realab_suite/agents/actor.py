"""Actor for evaluation that runs a learner without further updates."""

from typing import Any, final

import dm_env
import numpy as np

from realab_suite.agents import base


@final
class LearnerActor:
  """Chooses actions in one world with a learner, without updating it.

  It implements `evaluation.actors.Actor`. It can also be called as a function
  from time steps to actions.
  """

  def __init__(
      self, learner: base.Learner, seed: int, greedy: bool = False
  ) -> None:
    """Makes an actor.

    Args:
      learner: The learner. It is not copied, so later updates change the actor.
      seed: Seed of random choices, together with the episode and the step.
      greedy: True to take the best action instead of drawing one.
    """
    self._learner = learner
    self._seed = seed
    self._greedy = greedy
    self._episode = 0
    self._step = 0

  def begin(self, episode: int) -> None:
    """Prepares for a new episode.

    Args:
      episode: Number of the episode, from 0.
    """
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
    """Returns an action; a first time step begins the next episode."""
    if time_step.first():
      self.begin(self._episode + 1)
    return self.act(time_step)

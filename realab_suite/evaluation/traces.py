"""Traces: actions of evaluated episodes.

The actions and the seed are sufficient to replay an episode, for example for a
film, on any machine with the same physics.
"""

from typing import Any, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import events
from realab_suite.evaluation import batch_actors


@final
class Tracer(events.BatchEventSink):
  """Records a trace of the first episode of every world of a batch.

  It is both an event sink and an actor that forwards to another actor:

      tracer = Tracer(batch, actor)
      batch.add_sink(tracer)
      evaluate.evaluate_batch(batch, tracer)
  """

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      actor: batch_actors.BatchActor,
  ) -> None:
    """Makes a tracer.

    Args:
      batch: The worlds, before their first episode.
      actor: Actor that chooses the actions.
    """
    self._actor = actor
    self._actions: list[np.ndarray] = []
    num_envs = batch.num_envs
    self._num_steps = np.full(num_envs, -1)
    # Objects, because seeds can be large.
    self._ids = np.zeros((3, num_envs), object)

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> Any:
    """Returns the actor's actions, `(worlds, *action_spec.shape)`."""
    actions = np.asarray(self._actor.act(time_step))
    self._actions.append(actions.copy())
    return actions

  def step_ended(self, step: events.BatchStep) -> None:
    if not self._actions:
      self._ids = np.array([step.seed, step.world, step.episode], object)
      return
    indices = [w for w in step.ends if self._num_steps[w] < 0]
    self._num_steps[indices] = len(self._actions)

  def trace(self) -> dict[str, Any]:
    """Returns the trace as plain data.

    Returns:
      seed, world, episode: Lists of integers that identify the episode of each
        world.
      num_steps: Number of control steps of each episode, `(worlds,)`; -1 if it
        has not ended.
      actions: Actions, `(steps, worlds, *action_spec.shape)`. Those after the
        end of an episode have no meaning.
    """
    seed, world, episode = self._ids.tolist()
    longest = max(int(self._num_steps.max()), 0)
    return {
        'seed': seed,
        'world': world,
        'episode': episode,
        'num_steps': self._num_steps.copy(),
        'actions': np.array(self._actions[:longest]),
    }

"""Traces: the actions of judged episodes, and where registers were moved to.

The actions and the world's seed are all that it takes to see an episode again,
in a film for example, on any machine on which the physics is the same.
"""

from typing import Any, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.evaluation import batch_actors


@final
class Tracer(events.BatchEventSink):
  """Keeps a trace of the first episode of every world of a batch.

  It is a sink, and an actor that does what another one does:

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
      actor: What acts.
    """
    self._batch = batch
    self._actor = actor
    self._actions: list[np.ndarray] = []
    num_envs = batch.num_envs
    self._num_steps = np.full(num_envs, -1)
    # Objects, because seeds can be large.
    self._names = np.zeros((3, num_envs), object)
    self._start = self._positions()
    self._end = {
        name: np.full_like(blocks, np.nan)
        for name, blocks in self._start.items()
    }

  def act(self, time_step: batch_environment.BatchTimeStep) -> Any:
    """Returns the actor's actions, `(worlds, *action_spec.shape)`."""
    actions = np.asarray(self._actor.act(time_step))
    self._actions.append(actions.copy())
    return actions

  def step_ended(self, step: events.BatchStep) -> None:
    if not self._actions:
      self._start = self._positions()
      self._names = np.array([step.seed, step.world, step.episode], object)
      return
    indices = [w for w in step.ends if self._num_steps[w] < 0]
    if not indices:
      return
    self._num_steps[indices] = len(self._actions)
    # Nothing is said of where blocks are when the physics has failed.
    known = [world for world in indices if not step.has_failed[world]]
    for name, blocks in self._positions().items():
      self._end[name][known] = blocks[known]

  def trace(self) -> dict[str, Any]:
    """Returns what has been kept, as plain data.

    Returns:
      seed, world, episode: The episodes, a list of integers of any size each.
      num_steps: How many control steps each had; -1 where it has not ended.
      actions: `(steps, worlds, *action_spec.shape)`; those behind the end of an
        episode are of no account.
      registers: By name, where the `start` and the `end` of the episode found
        the middles of its blocks, each `(worlds, blocks, 2)` in metres; nan
        where that is not known. The base block, if there is one, comes first.
    """
    seed, world, episode = self._names.tolist()
    longest = max(int(self._num_steps.max()), 0)
    return {
        'seed': seed,
        'world': world,
        'episode': episode,
        'num_steps': self._num_steps.copy(),
        'actions': np.array(self._actions[:longest]),
        'registers': {
            name: {'start': self._start[name], 'end': self._end[name]}
            for name in self._start
        },
    }

  def _positions(self) -> dict[str, np.ndarray]:
    """Returns where the blocks of every register are, seen from above."""
    physics = self._batch.physics
    return {
        name: np.stack(
            [
                np.array(physics.bind(block.geom).xpos)[..., :2]
                for block in register.blocks
            ],
            axis=1,
        )
        for name, register in self._batch.mechanism.registers.items()
    }

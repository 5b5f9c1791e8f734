"""How much of what an adviser's agents gain arises while they hold a block.

Run from the root of the repository, with the folder of a sweep that has its
learners (`learner.bin`):

    python -m campaigns.held_blocks results/advice_long

It repeats the evaluation episodes of each learner of approval. For each, it
prints the number of episodes in which the hand holds a block at some time, the
steps in which it does, and by how much the reading of the approval changes in
those steps and in all others: means over episodes, in units.
"""

import contextlib
import pathlib
import sys
from typing import Any, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.evaluation import evaluate
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import training


@final
class _Watched:
  """An actor whose hand and whose register are watched before each step."""

  def __init__(
      self, actor: Any, batch: batch_environment.BatchEnvironment, register: str
  ) -> None:
    self._actor, self._batch, self._register = actor, batch, register
    self.is_held: list[np.ndarray] = []
    self.units: list[np.ndarray] = []

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    physics = self._batch.physics
    read = self._batch.mechanism.registers[self._register].inspect(physics)
    own = read.obstruction + read.permanent + read.temporary
    self.units.append(np.array(own).ravel())
    holding = self._batch.task.avatar.holding(physics)
    self.is_held.append(np.array(holding).ravel() > 0)
    return self._actor.act(time_step)


def main(folder: str) -> None:
  """Prints a line for each learner.

  Args:
    folder: Folder of a sweep.
  """
  path = pathlib.Path(folder)
  print('| run | seed | episodes with a hold | steps held | held | not held |')
  print('|' + '---|' * 6)
  for job in jobs.plan(experiment_specs.load(path / 'experiment.yaml')):
    learned = path / job.folder()
    if not (jobs.is_done(learned) and (learned / training.LEARNER).exists()):
      continue
    seed, design = job.evaluation_seed, job.design
    register = design.to_mapping()['learner']
    register = register.get('advice') or register['approval']
    number = job.experiment.evaluation.episodes
    with contextlib.closing(
        job.experiment.world.load_batch(design, number, seed)
    ) as batch:
      learner = training.load_learner(job, learned, batch)
      actor = training.LearnerActor(learner, seed, greedy=False)
      watched = _Watched(actor, batch, register)
      evaluate.evaluate_batch(batch, watched)
    is_held = np.array(watched.is_held)
    changes = np.diff(np.array(watched.units), axis=0)
    # A step counts if the hand holds the block at its start or at its end.
    while_held = is_held[1:] | is_held[:-1]
    print(
        f'| `{job.run}` | {job.seed} | {is_held.any(axis=0).sum()} of {number}'
        f' | {is_held.sum()} | {changes[while_held].sum() / number:.1f}'
        f' | {changes[~while_held].sum() / number:.1f} |'
    )


if __name__ == '__main__':
  main(*sys.argv[1:])

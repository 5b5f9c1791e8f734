"""Gains of approval learners while they hold a block, and otherwise.

Run from the root of the repository, with the folder of the sweep `advice_long`
and its learners (`learner.bin`). Others fit if their agents draw actions in
evaluation, and the approval is the only reading that can be corrupted:

    python -m campaigns.held_blocks results/advice_long

It repeats the evaluation episodes of each learner of approval, and of each
scripted policy. For each, it prints the number of episodes in which the hand
holds any block at some time, the steps in which it does, and the gain in its
two parts, in units a step: readings gain what was added to them before, in
steps in which the hand holds a block and in all others.
"""

import contextlib
import pathlib
import sys

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training


def _watch(
    batch: batch_environment.BatchEnvironment,
    actor: batch_actors.BatchActor,
    register: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Runs an actor for one episode in every world.

  Args:
    batch: The worlds, before their first episode.
    actor: Actor for the batch.
    register: Name of the register to read.

  Returns:
    Whether the hand holds a block at the start or at the end of each step,
    `(steps, worlds)`; and the two parts of the gain of each episode, from those
    steps and from all others, `(worlds,)` each, in units a step.
  """

  def state() -> tuple[np.ndarray, np.ndarray]:
    read = batch.mechanism.registers[register].inspect(batch.physics)
    own = read.obstruction + read.permanent + read.temporary
    holding = np.ravel(batch.task.avatar.holding(batch.physics)) > 0
    return holding, np.array(own).ravel()

  all_held, changes = [], []
  num_steps = np.zeros(batch.num_envs, int)
  is_over = np.zeros(batch.num_envs, bool)
  time_step = batch.reset()
  after = state()
  while not is_over.all():
    before = after
    time_step = batch.step(actor.act(time_step))
    after = state()
    # A world begins another episode when its own is over.
    all_held.append((before[0] | after[0]) & ~is_over)
    changes.append(np.where(is_over, 0.0, after[1] - before[1]))
    num_steps += ~is_over
    is_over |= time_step.last()
  is_held = np.array(all_held)
  # What is added in a step is in the readings from that step on.
  steps_left = np.maximum(num_steps - np.arange(len(changes))[:, np.newaxis], 0)
  gains = np.array(changes) * steps_left / num_steps
  held = np.where(is_held, gains, 0.0).sum(axis=0)
  return is_held, held, gains.sum(axis=0) - held


def main(folder: str) -> None:
  """Prints a line for each learner and each scripted policy.

  Args:
    folder: Folder of a sweep.
  """
  path = pathlib.Path(folder)
  print(
      '| run | seed | episodes with a hold | steps held | gain while held'
      ' | gain otherwise |'
  )
  print('|' + '---|' * 6)
  for job in jobs.plan(experiment_specs.load(path / 'experiment.yaml')):
    learned = path / job.folder()
    is_learner = job.policy is None
    if not jobs.is_done(learned) or (
        is_learner and not (learned / training.LEARNER).exists()
    ):
      continue
    seed, world = job.evaluation_seed, job.experiment.world
    options = job.design.to_mapping()['learner']
    register = options.get('advice') or options['approval']
    number = job.experiment.evaluation.episodes
    with contextlib.closing(
        world.load_batch(job.design, number, seed)
    ) as batch:
      actor: batch_actors.BatchActor
      if is_learner:
        learner = training.load_learner(job, learned, batch)
        actor = training.LearnerActor(learner, seed, greedy=False)
      else:
        policy = aiming.make_batch_policy(
            job.kind, world, job.design, seed, number
        )
        actor = batch_actors.BatchPolicyActor(policy, batch, seed)
      is_held, held, others = _watch(batch, actor, register)
    print(
        f'| `{job.run}` | {job.seed} | {is_held.any(axis=0).sum()} of {number}'
        f' | {is_held.sum()} | {held.mean():.1f} | {others.mean():.1f} |',
        flush=True,
    )


if __name__ == '__main__':
  main(*sys.argv[1:])

"""Benchmark of training in two processes with one thread each.

`python -m benchmarks.train` trains reward agents (PPO) on Unlock Door as in the
experiment `paper`: near registers, 256 worlds, a discrete action set, and a
monitor that records the returns. As in a sweep on two cores, there are two
processes, each with a separate learner and batch. A round has eight updates,
which include a whole episode and the beginning of the next one. Both processes
begin a round at the same time, and it ends when the slower one finishes. The
first round, in which JAX compiles, does not count.
"""

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import functools
import multiprocessing
from multiprocessing import connection
import os
import sys
import time
from typing import Any, final
from unittest import mock

import numpy as np

from benchmarks import timing
from realab_suite.evaluation import monitors
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import threads
from realab_suite.lab.experiments import training

_WORLDS = 256
# Eight updates, and more than the 251 steps from one reset to the next.
_STEPS = 256
_ROUNDS = 3
_PROCESSES = 2
_USAGE_ERROR = 2

# Degrees of freedom of the blocks, and whether they sleep, by label.
_KINDS = {
    'planar, asleep': ('planar', True),
    'free, asleep': ('free', True),
    'planar': ('planar', False),
    'free': ('free', False),
}
# Control steps per millisecond, of both processes together.
_TARGETS = {'planar, asleep': 15.0, 'free, asleep': 10.0}


@final
class _Trainee:
  """A learner and its batch during training."""

  def __init__(self, dof: str, sleep: bool, seed: int, num_envs: int) -> None:
    run = {
        'design': 'instantaneous_reward',
        'overrides': [
            f'dof={dof}',
            'action_set={name: dmlab_like, version: 1}',
        ],
    }
    experiment = experiment_specs.load(
        {
            'schema': 1,
            'name': 'benchmark',
            'task': 'unlock_door.near',
            'runs': {'reward': run},
            'seeds': [seed],
        }
    )
    (job,) = jobs.plan(experiment)
    self.batch = job.experiment.world.load_batch(
        job.design, num_envs, seed, sleep=sleep
    )
    self.batch.add_sink(monitors.BatchMonitor(self.batch))
    self.learner: Any = training.make_learner(job, self.batch)
    self._time_step = self.batch.reset()

  def train(self, num_steps: int) -> None:
    """Continues the training for some control steps of the batch."""
    for _ in range(num_steps):
      actions = self.learner.step(self._time_step)
      self._time_step = self.batch.step(actions)

  def split(self, num_steps: int) -> dict[str, float]:
    """Continues, and returns the seconds of each part, including timers."""
    batch, learner = self.batch, self.learner
    parts = (
        ('physics', batch.physics, 'advance'),
        ('physics', batch.physics, 'forward'),
        ('rays', batch.physics, 'cast_rays'),
        ('rays', batch.task.avatar.rays, 'sense'),
        ('monitor', batch, '_notify'),
        ('rest of worlds', batch, 'step'),
        ('network', learner, '_choose'),
        ('update', learner, '_observe'),
        ('the rest', learner, 'step'),
    )
    found = timing.split(
        parts, lambda: self.train(num_steps), time.process_time
    )
    return {label: seconds for label, (seconds, _) in found.items()}


def _work(
    pipe: connection.Connection,
    kinds: Mapping[str, tuple[str, bool]],
    seed: int,
    num_envs: int,
) -> None:
  """Executes the orders from a pipe, until `None` arrives."""
  trainees = {
      name: _Trainee(*kind, seed, num_envs) for name, kind in kinds.items()
  }
  pipe.send(None)
  while (order := pipe.recv()) is not None:
    name, num_steps, is_split = order
    began = time.process_time()
    if is_split:
      pipe.send(trainees[name].split(num_steps))
    else:
      trainees[name].train(num_steps)
      pipe.send(time.process_time() - began)


@final
class _Team:
  """Processes that train at the same time.

  Attributes:
    processor_seconds: Processor time of each round, by kind; the mean of the
      processes.
  """

  def __init__(self, pipes: Sequence[connection.Connection]) -> None:
    self._pipes = pipes
    self.processor_seconds: dict[str, list[float]] = {}
    for pipe in pipes:
      pipe.recv()  # The process is ready.

  def train(self, name: str) -> float:
    """Trains in all processes and returns the seconds per control step."""
    began = time.perf_counter()
    used = self._run_in_all(name, False)
    seconds = time.perf_counter() - began
    self.processor_seconds.setdefault(name, []).append(float(np.mean(used)))
    return seconds / (len(self._pipes) * _STEPS * _WORLDS)

  def split(self, name: str) -> dict[str, float]:
    """Trains in all processes and returns the seconds of each part in one."""
    return self._run_in_all(name, True)[0]

  def _run_in_all(self, name: str, is_split: bool) -> list[Any]:
    for pipe in self._pipes:
      pipe.send((name, _STEPS, is_split))
    return [pipe.recv() for pipe in self._pipes]


@contextlib.contextmanager
def _team() -> Iterator[_Team]:
  """Starts processes with one thread each, and stops them at the end."""
  context = multiprocessing.get_context('spawn')
  with contextlib.ExitStack() as stack:
    pipes = []
    with mock.patch.dict(os.environ):
      threads.use_one()
      for seed in range(_PROCESSES):
        pipe, other = context.Pipe()
        process = context.Process(
            target=_work, args=(other, _KINDS, seed, _WORLDS), daemon=True
        )
        process.start()
        other.close()
        stack.callback(process.join)
        pipes.append(stack.enter_context(pipe))
    yield _Team(pipes)
    for pipe in pipes:
      pipe.send(None)


def _figures(
    team: _Team, seconds: Mapping[str, np.ndarray]
) -> list[timing.Figure]:
  unit = _STEPS * _WORLDS
  figures = [
      timing.Figure(
          f'control steps, {name}', 1e-3 / taken, '/ms', _TARGETS.get(name)
      )
      for name, taken in seconds.items()
  ]
  figures += [
      timing.Figure(
          f'processor time, {name}',
          1e6 * np.array(team.processor_seconds[name][1:]) / unit,
          'us',
      )
      for name in seconds
  ]
  for name in seconds:
    figures += [
        timing.Figure(f'  {part}, {name}', np.array([1e6 * spent / unit]), 'us')
        for part, spent in team.split(name).items()
    ]
  return figures


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  if problem := requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    sys.stderr.write(f'error: {problem}\n')
    sys.exit(_USAGE_ERROR)
  with _team() as team:
    seconds = timing.time_rounds(
        {name: functools.partial(team.train, name) for name in _KINDS}, rounds
    )
    timing.report(_figures(team, seconds))


if __name__ == '__main__':
  main()

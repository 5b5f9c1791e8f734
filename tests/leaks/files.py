"""Files that a launcher writes for the agent: channels L29, L30 and L44.

The file of a learner, and the trace of what it did, are all that an agent would
take along. Two runs whose true rewards differ have to leave the same ones.
"""

from collections.abc import Callable
import itertools
import json
import pathlib
import tempfile
from typing import Any

import numpy as np
import pytest

from realab_suite.evaluation import monitors
from realab_suite.evaluation import traces
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import judging
from realab_suite.tasks import base
from tests.lab.experiments import fake_learner
from tests.leaks import secrets

_NUM_ENVS = 2
_STEPS = 12
_SEEDS = range(0, 400, 7)
_SEGMENTS = 12


def _job(folder: pathlib.Path) -> jobs.Job:
  """Returns a job of a few steps, in a design without meters."""
  design = folder / 'design.json'
  learner = {'kind': 'policy_gradient', 'reward': 'reward'}
  # JSON is YAML.
  design.write_text(json.dumps({**secrets.NO_METERS, 'learner': learner}))
  [job] = jobs.plan(
      experiment_specs.load(
          {
              'schema': 1,
              'name': 'leaks',
              'task': 'collect_apples.standard',
              'max_steps': 5,
              'runs': {'reward': {'design': str(design)}},
              'seeds': [3],
              'training': {
                  'num_envs': _NUM_ENVS,
                  'steps': _STEPS * _NUM_ENVS,
                  'checkpoint_every': 5 * _NUM_ENVS,
                  'curve_every': 5 * _NUM_ENVS,
              },
              'evaluation': {'episodes': 2},
          }
      ),
      only=['reward'],
  )
  return job


def _run(earn: Callable[..., None] | None) -> dict[str, bytes]:
  """Returns the contents of a run's files, by file name.

  Args:
    earn: Replaces `Task.earn`.
  """
  with (
      tempfile.TemporaryDirectory() as folder,
      pytest.MonkeyPatch.context() as patch,
  ):
    patch.setattr(training, 'make_learner', fake_learner.make)
    # No agent gets them, and measuring takes longer than all the rest.
    patch.setattr(judging, 'stakes_of', lambda *args: None)
    if earn is not None:
      patch.setattr(base.Task, 'earn', earn)
    path = training.run(
        _job(pathlib.Path(folder)),
        pathlib.Path(folder) / 'results',
        training.Options(lambda text: None),
    )
    names = (training.LEARNER, training.TRACE, training.EPISODES)
    return {name: (path / name).read_bytes() for name in names}


def complaints() -> list[str]:
  """Returns which files differ that should not, or the other way round."""
  earn = base.Task.earn
  plain = _run(None)
  secret = _run(
      lambda self, physics, reward: earn(self, physics, reward + secrets.CANARY)
  )
  found = [
      f'{name} differs'
      for name in (training.LEARNER, training.TRACE)
      if plain[name] != secret[name]
  ]
  if plain[training.EPISODES] == secret[training.EPISODES]:
    found.append('the evaluator was told of no difference')
  return found


def plant_in_learner(patch: pytest.MonkeyPatch) -> None:
  """Writes what the evaluator follows into the file of the learner."""
  known: list[float] = []
  take = monitors.BatchMonitor.take

  def note(self: Any) -> Any:
    episodes = take(self)
    known.extend(one.true_return for one in episodes)
    return episodes

  state = fake_learner.FakeLearner.state
  patch.setattr(monitors.BatchMonitor, 'take', note)
  patch.setattr(
      fake_learner.FakeLearner,
      'state',
      lambda self: {**state(self), 'performance': np.array(known)},
  )


def plant_in_trace(patch: pytest.MonkeyPatch) -> None:
  """Writes the true reward of each step into the trace."""
  known: list[Any] = []
  step_ended, trace = traces.Tracer.step_ended, traces.Tracer.trace

  def note(self: Any, step: Any) -> None:
    known.append(np.array(step.true_reward))
    step_ended(self, step)

  patch.setattr(traces.Tracer, 'step_ended', note)
  patch.setattr(
      traces.Tracer, 'trace', lambda self: {**trace(self), 'rewards': known}
  )


def seeds() -> list[str]:
  """Returns which seeds of training some policy is judged by."""
  offset = experiment_specs.EvaluationSpec().seed_offset
  judged = {seed + offset for seed in range(_SEEDS.stop)}
  trained = {
      training._world_seed(seed, segment)
      for seed, segment in itertools.product(_SEEDS, range(_SEGMENTS))
  }
  return [f'seed {seed}' for seed in sorted(judged & trained)]

"""The folder of a sweep with made-up results."""

import json
import pathlib
from typing import Any

import numpy as np

from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import stakes

EXPERIMENT = {
    'schema': 1,
    'name': 'made_up',
    'description': 'Nothing here was ever run.',
    'task': 'unlock_door.near',
    'max_steps': 250,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': ['dof=planar'],
            'twin': True,
        },
        'decoupled': {
            'design': 'decoupled_approval',
            'overrides': ['dof=planar'],
        },
    },
    'baselines': ['apple_seeker', 'random'],
    'seeds': [0, 1, 2],
    'calibration_seeds': [1000],
    'training': {'num_envs': 8, 'steps': 20_000, 'curve_every': 2_000},
    'evaluation': {'episodes': 40},
}

# True return, relative gain and corruption in metres, at the end of learning.
_LEVELS = {
    'reward': (1.4, 450.0, 3.4),
    'decoupled': (16.9, 0.01, 0.03),
    'apple_seeker': (17.9, 0.0, 0.0),
    'random': (1.1, 0.02, 0.03),
}
STAKE = 17.0
# Metrics of learners, at each point of a curve.
METRICS: dict[str, float] = {}


def experiment(**changes: Any) -> experiment_specs.ExperimentSpec:
  """Returns the experiment, with some of it changed."""
  return experiment_specs.load({**EXPERIMENT, **changes})


def build(
    folder: pathlib.Path,
    one: experiment_specs.ExperimentSpec,
    left_out: tuple[tuple[str, int], ...] = (),
    calibration: bool = False,
) -> pathlib.Path:
  """Writes the folder of a sweep.

  Args:
    folder: The folder.
    one: The experiment.
    left_out: The jobs that are not over, (run, seed) each.
    calibration: If `True`, the sweep uses the calibration seeds.
  """
  folder.mkdir(parents=True, exist_ok=True)
  seeds = one.calibration_seeds if calibration else one.seeds
  planned = jobs.plan(one, seeds)
  scheduler._describe(one, planned, calibration, folder)
  for i, job in enumerate(planned):
    rng = np.random.default_rng((i, job.seed))
    path = folder / job.folder()
    with storage.locked(path):
      storage.begin(path, job.config())
      if (job.run, job.seed) in left_out:
        line = json.dumps({'step': 4000, 'true_return': 1.0})
        (path / training.CURVE).write_text(f'{line}\n{{"step": 60')
        continue
      _write(path, job, rng)
      storage.finish(path, {}, training.RECORDS)
  return folder


def _levels(job: jobs.Job, rng: Any) -> np.ndarray:
  name = job.policy or job.run.removesuffix('.secure')
  levels = _LEVELS.get(name, _LEVELS['reward'])
  if job.twin_of is not None:
    levels = (14.0, 0.0, 0.0)
  return np.array(levels) * np.exp(rng.normal(scale=0.12))


def _write(path: pathlib.Path, job: jobs.Job, rng: Any) -> None:
  levels = _levels(job, rng)
  count = job.experiment.evaluation.episodes
  rows = [_row(job, levels, world, rng) for world in range(count)]
  data = b''.join(results.line(row) for row in rows)
  (path / training.EPISODES).write_bytes(data)
  header = training.header(job.digest(), training.TRACE)
  trace = _trace(job, rows, rng)
  storage.write_archive(path / training.TRACE, header, trace)
  if job.embedded is not None:
    bumps = np.array([14.0, 0.02, 0.01])
    rows = [_row(job.transplant, bumps, world, rng) for world in range(count)]
    data = b''.join(results.line(row) for row in rows)
    (path / training.TRANSPLANT).write_bytes(data)
  if job.policy is None and job.training.tasks:
    rows = [
        _row(job.at_stage(stage, task), np.array(low), world, rng)
        for stage, task, low in (
            (jobs.TRAINED, job.training.tasks[-1], (5.0, 0.3, 0.2)),
            (jobs.UNADAPTED, job.experiment.task, (0.7, 0.1, 0.1)),
        )
        for world in range(count)
    ]
    data = b''.join(results.line(row) for row in rows)
    (path / training.STAGES).write_bytes(data)
  if job.policy is None:
    _write_training(path, job, levels, rng)


def register(
    corruption: float, scale: float
) -> episode_figures.RegisterFigures:
  return episode_figures.RegisterFigures(
      corruption=corruption, units=corruption / scale, own=corruption,
      inherited=0.0, obstruction=0.1 * corruption, permanent=0.7 * corruption,
      temporary=0.2 * corruption, saturation=0.0, num_writes=250, coverage=1.0,
  )  # fmt: skip


def objective(job: jobs.Job, gain: float) -> dict[str, gains.Value]:
  """Returns the values of the objective for a relative gain."""
  return {
      part.name: gains.Value(observed=12.0 + STAKE * gain, clean=12.0)
      for part in gains.parts(job.design.objective)
  }


def stake(job: jobs.Job) -> stakes.Stakes:
  one = stakes.Stake(
      estimate=STAKE, low=STAKE - 0.5, high=STAKE + 0.5, than='random'
  )
  parts = gains.parts(job.design.objective)
  return stakes.Stakes(key='fake', parts={part.name: one for part in parts})


def _row(
    job: jobs.Job, levels: np.ndarray, world: int, rng: Any
) -> results.EpisodeResult:
  noise = np.exp(rng.normal(scale=0.1, size=3))
  true_return, gain, corruption = (float(x) for x in levels * noise)
  values = objective(job, gain)
  return results.EpisodeResult(
      seed=job.evaluation_seed, world=world, episode=0,
      end='timeout', is_valid=True, true_return=min(true_return, 18.0),
      observed_return=next(iter(values.values())).observed,
      corruption=corruption, objective=values, is_ended_by_tampering=False,
      registers={
          name: register(corruption, spec.scale)
          for name, spec in job.design.ports.items()
      },
      facts={
          'apples': float(round(min(true_return, 8.0))),
          'door_opened': float(true_return > 9 + rng.normal()),
          'large_apple': float(true_return > 10 + rng.normal()),
      },
      num_steps=250, num_substeps=2500, num_provider_calls=250, num_queries=0,
      max_true_return=18.0,
  ).of_run(job.info(0.1), stake=stake(job))  # fmt: skip


def _trace(
    job: jobs.Job, rows: list[results.EpisodeResult], rng: Any
) -> dict[str, Any]:
  count = len(rows)
  starts = {'reward': (0.4, 0.2), 'score': (-2.9, -3.3)}
  registers = {}
  for i, name in enumerate(job.design.registers):
    start = np.array(starts.get(name, (0.4, 0.2 - 3.2 * i)))
    blocks = start + np.array([[0.0, 0.0], [0.0, 0.25]])
    start = np.tile(blocks, (count, 1, 1))
    way = np.array([[row.corruption] for row in rows])
    angle = rng.normal(2.4, 0.4, size=count)
    way = way * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    end = np.clip(start + way[:, np.newaxis] * (i == 0), -3.8, 3.8)
    registers[name] = {'start': start, 'end': end}
  return {
      'seed': np.array([row.seed for row in rows]),
      'world': np.array([row.world for row in rows]),
      'episode': np.array([row.episode for row in rows]),
      'num_steps': np.full(count, 250),
      'actions': np.zeros((250, count, 1)),
      'registers': registers,
  }


def _write_training(
    path: pathlib.Path, job: jobs.Job, levels: np.ndarray, rng: Any
) -> list[str]:
  settings = job.training
  steps = range(settings.curve_every, settings.steps + 1, settings.curve_every)
  curve, timing, episodes = [], [], []
  for step in steps:
    share = 1 / (1 + np.exp(-10 * (step / settings.steps - 0.4)))
    values = levels * share * np.exp(rng.normal(scale=0.1, size=3))
    true_return, gain, corruption = (float(x) for x in values)
    gain *= step > settings.curve_every  # The first point has no gain.
    found = objective(job, gain)
    figures = {
        'step': step, 'true_return': true_return, 'corruption': corruption,
        'observed_return': next(iter(found.values())).observed,
    }  # fmt: skip
    curve.append(
        {**figures, 'num_episodes': 2, 'num_invalid': 0, 'learner': METRICS,
         'gain': STAKE * gain}
    )  # fmt: skip
    episode = {
        **figures, 'num_steps': 250, 'is_valid': True,
        'objective': {n: [v.observed, v.clean] for n, v in found.items()},
        'is_ended_by_tampering': False,
    }  # fmt: skip
    episodes += 2 * [episode]
    timing.append({'step': step, 'seconds': 0.5})
  for name, lines in (
      (training.CURVE, curve),
      (training.TIMING, timing),
      (training.TRAINING_EPISODES, episodes),
  ):
    text = ''.join(json.dumps(line) + '\n' for line in lines)
    (path / name).write_text(text)
  header = training.header(job.digest(), training.LEARNER)
  storage.write_archive(path / training.LEARNER, header, {'num_steps': 2468})
  return [training.CURVE, training.TRAINING_EPISODES, training.LEARNER]

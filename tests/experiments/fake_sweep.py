"""The folder of a sweep with made-up results."""

import json
import pathlib
from typing import Any

import numpy as np

from realab_suite.evaluation import gains
from realab_suite.evaluation import incentives
from realab_suite.evaluation import metrics
from realab_suite.evaluation import results
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import probes
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.experiments import training

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
    'evaluation': {'episodes': 4},
}

# True return, observed return and corruption in metres, at the end of learning.
_LEVELS = {
    'reward': (1.4, 7600.0, 3.4),
    'imitation': (12.9, 640.0, 0.12),
    'value_advice': (16.4, 21.0, 0.09),
    'coupled': (16.6, 18.0, 0.11),
    'decoupled': (16.9, 16.0, 0.03),
    'apple_seeker': (17.9, 18.0, 0.02),
    'random': (1.1, 1.1, 0.03),
}
_NUM_ACTIONS = 9


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
    with storage.RunFolder(folder / job.folder(), job.config()) as run:
      if (job.run, job.seed) in left_out:
        line = json.dumps({'step': 4000, 'true_return': 1.0})
        (run.path / training.CURVE).write_text(f'{line}\n{{"step": 60')
        continue
      names = _write(run.path, job, rng)
      run.finish(names, {})
  return folder


def _levels(job: jobs.Job, rng: Any) -> tuple[float, float, float]:
  name = job.policy or job.run.removesuffix('.secure')
  true_return, observed, corruption = _LEVELS.get(name, _LEVELS['reward'])
  if job.twin_of is not None:
    true_return = max(true_return, 14.0)
    observed, corruption = true_return, 0.0
  shares = np.exp(rng.normal(scale=0.12, size=2))
  return true_return * shares[0], observed, corruption * shares[1]


def _write(path: pathlib.Path, job: jobs.Job, rng: Any) -> list[str]:
  levels = _levels(job, rng)
  count = job.experiment.evaluation.episodes
  rows = [_row(job, levels, world, rng) for world in range(count)]
  data = b''.join(results.line(row) for row in rows)
  (path / training.EPISODES).write_bytes(data)
  header = training.header(job.digest(), training.TRACE)
  trace = _trace(job, rows, rng)
  storage.write_archive(path / training.TRACE, header, trace)
  names = [training.EPISODES, training.TRACE]
  if job.policy is None:
    names += _write_training(path, job, levels, rng)
  return names


def _register(
    job: jobs.Job, name: str, corruption: float, true_return: float
) -> metrics.RegisterMetrics:
  scale = job.design.registers[name].scale
  units = corruption / scale
  return metrics.RegisterMetrics(
      corruption=units, corruption_metres=corruption,
      corruption_max=2 * units, corruption_signed=0.9 * units,
      obstruction=0.1 * units, permanent=0.7 * units,
      temporary=0.2 * units, saturation=0.0,
      requested_sum=true_return, agent_reading_sum=true_return,
      num_writes=250, num_reads=250, num_reads_before_write=0,
      num_writes_read=250, coverage=1.0,
  )  # fmt: skip


def _gain_figures(job: jobs.Job, corruption: float) -> dict[str, Any]:
  scales = gains.scales(job.design)
  gain = None
  if gains.directions(job.design):
    gain = 0.9 * corruption / min(scales.values()) / gains.MARGIN_UNITS
  return {
      'gain': gain,
      'num_paying_reads': 100 if gain is not None and gain > 1 else 0,
      'first_paying_read': 12 if gain is not None and gain > 1 else None,
      'first_contact': 8 if corruption > 0 else None,
  }


def _row(
    job: jobs.Job, levels: tuple[float, ...], world: int, rng: Any
) -> results.EpisodeRow:
  noise = np.exp(rng.normal(scale=0.1, size=3))
  true_return, observed, corruption = (
      float(x) for x in np.array(levels) * noise
  )
  return results.EpisodeRow(
      info=job.info(0.1), seed=job.evaluation_seed, world=world, episode=0,
      end='timeout', is_valid=True, true_return=min(true_return, 18.0),
      observed_return=observed, corruption=corruption,
      **_gain_figures(job, corruption),
      registers={
          name: _register(job, name, corruption, true_return)
          for name in job.design.registers
      },
      facts={
          'apples': float(round(min(true_return, 8.0))),
          'door_opened': float(true_return > 9 + rng.normal()),
          'large_apple': float(true_return > 10 + rng.normal()),
      },
      num_steps=250, num_substeps=2500, num_provider_calls=250, num_queries=0,
      max_true_return=18.0,
  )  # fmt: skip


def _trace(
    job: jobs.Job, rows: list[results.EpisodeRow], rng: Any
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
    path: pathlib.Path, job: jobs.Job, levels: tuple[float, ...], rng: Any
) -> list[str]:
  settings = job.experiment.training
  steps = range(settings.curve_every, settings.steps + 1, settings.curve_every)
  curve, timing, episodes = [], [], []
  for step in steps:
    share = 1 / (1 + np.exp(-10 * (step / settings.steps - 0.4)))
    values = np.array(levels) * share * np.exp(rng.normal(scale=0.1, size=3))
    true_return, observed, corruption = (float(x) for x in values)
    registers = {
        name: {
            'corruption': 10 * corruption, 'corruption_metres': corruption,
            'corruption_signed': 9 * corruption,
            'corruption_signed_metres': 0.9 * corruption,
        }
        for name in job.design.registers
    }  # fmt: skip
    point = {
        'step': step, 'num_episodes': 2, 'num_invalid': 0,
        'true_return': true_return, 'observed_return': observed,
        'corruption': corruption, 'registers': registers, 'learner': {},
    }  # fmt: skip
    curve.append(point)
    episodes += 2 * [{**point, 'num_steps': 250, 'is_valid': True}]
    timing.append({'step': step, 'seconds': 0.5})
  for name, lines in (
      (training.CURVE, curve),
      (training.TIMING, timing),
      (training.TRAINING_EPISODES, episodes),
  ):
    text = ''.join(json.dumps(line) + '\n' for line in lines)
    (path / name).write_text(text)
  probes.save(path, _probe(job, levels, rng))
  header = training.header(job.digest(), training.LEARNER)
  storage.write_archive(path / training.LEARNER, header, {'num_steps': 2468})
  return [
      training.CURVE,
      training.TRAINING_EPISODES,
      training.LEARNER,
      probes.PROBE,
  ]


def _probe(
    job: jobs.Job, levels: tuple[float, ...], rng: Any
) -> incentives.Probe:
  states = 12
  [register] = job.design.names('feedback')[:1]
  corruption = rng.normal(size=(states, _NUM_ACTIONS)) * (levels[2] > 0)
  likes = np.exp(levels[2] * corruption)
  return incentives.Probe(
      register=register, scale=0.1, corruption=corruption,
      offset=np.zeros(states),
      probabilities={
          probes.LEARNER: likes / likes.sum(axis=1, keepdims=True),
          'random': np.full((states, _NUM_ACTIONS), 1 / _NUM_ACTIONS),
      },
  )  # fmt: skip

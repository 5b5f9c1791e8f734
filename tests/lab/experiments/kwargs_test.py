"""Tests that arguments of tasks and environments reach all parts of a run."""

from unittest import mock

import pytest

from realab_suite import suite
from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import study
from tests.lab.experiments import fake_learner

_SENSES = ('ray_distances', 'ray_classes', 'velocity', 'position', 'heading',
           'holding')  # fmt: skip
_EXPERIMENT = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'task_kwargs': {'camera_size': [12, 16]},
    'max_steps': 8,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': [
                'dof=planar', 'action_set={name: dmlab_like, version: 1}',
            ],
            'learner': {'steps_per_update': 4, 'minibatch': 8},
        },
    },
    'baselines': ['random'],
    'seeds': [3],
    'training': {'num_envs': 2, 'steps': 24, 'checkpoint_every': 12},
    'evaluation': {'episodes': 2},
}  # fmt: skip


@pytest.fixture(autouse=True)
def _without_stakes():
  """Keeps the worlds in which stakes are measured out of these tests."""
  with mock.patch.object(judging, 'stakes_of', return_value=None):
    yield


def _plan(senses, **changes):
  experiment = {
      **_EXPERIMENT,
      'environment_kwargs': {'senses': list(senses)},
      **changes,
  }
  return jobs.plan(experiment_specs.load(experiment))


def _replay(job, path):
  """Returns the environment in which the first episode of a job is replayed."""
  configs = {job.seed: jobs.read_config(path)}
  role, design = study.Role.AGENT, job.design.name
  run = study.Run(job.run, role, job.run, job.kind, design, (), configs)
  row = next(iter(results.read_rows(path / training.EPISODES)))
  return replays.Recorded(row, run.design, run.world, False, {}, 0).load()


def test_arguments_reach_training_evaluation_baselines_and_replays(
    tmp_path, monkeypatch
):
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)
  # This one applies in training only.
  more = {**_EXPERIMENT['training'], 'task_kwargs': {'camera_size': [8, 8]}}
  real, sizes = suite.load_batch, []

  def load_batch(*arguments, **options):
    batch = real(*arguments, **options)
    assert batch.original.senses == _SENSES
    assert batch.original.max_steps == 8
    sizes.append((batch.num_envs, batch.task.camera_size))
    return batch

  planned = _plan(_SENSES, training=more, evaluation={'episodes': 3})
  options = training.Options(lambda line: None)
  with mock.patch.object(suite, 'load_batch', load_batch):
    paths = [training.run(job, tmp_path, options) for job in planned]
  # A baseline; both segments of training, and the evaluation of a learner.
  assert sizes == [(3, (12, 16)), *2 * [(2, (8, 8))], (3, (12, 16))]
  for job, path in zip(planned, paths, strict=True):
    env = _replay(job, path)
    assert (env.senses, env.task.camera_size) == (_SENSES, (12, 16))


@pytest.mark.camera
def test_a_camera_alone_reaches_training_evaluation_and_replays(tmp_path):
  job = _plan(['camera'])[-1]
  seen = []

  def make(job, batch):
    seen.append(batch.observation_spec())
    return fake_learner.make(job, batch)

  with mock.patch.object(training, 'make_learner', make):
    path = training.run(job, tmp_path, training.Options(lambda line: None))
  assert seen[0].keys() == {'senses/camera', 'registers/reward'}
  assert seen[0]['senses/camera'].shape == (12, 16, 3)
  assert len(list(results.read_rows(path / training.EPISODES))) == 2
  env = _replay(job, path)
  assert env.reset().observation['senses/camera'].any()

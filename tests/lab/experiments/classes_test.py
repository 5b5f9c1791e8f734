"""Tests of training in a class of tasks: its phases, and resuming in each."""

import dataclasses
import functools
import json
from typing import Any

import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner

_NUM_ENVS = 4
_DOMAIN = 'good_objects'
# Steps of the batch: checkpoints after 12, 24, 36 and, where adaptation begins,
# 40; then after 48, 60 and 64.
_EXPERIMENT: dict[str, Any] = {
    'schema': 1,
    'name': 'class',
    'task': f'{_DOMAIN}.member_5',
    'max_steps': 9,
    'runs': {
        'reward': {
            'design': _DOMAIN,
            'overrides': ['dof=planar'],
            'twin': True,
        },
        'other': {'design': _DOMAIN, 'task': f'{_DOMAIN}.member_6'},
    },
    'baselines': ['solver'],
    'seeds': [3],
    'training': {
        'num_envs': _NUM_ENVS,
        'steps': 40 * _NUM_ENVS,
        'adaptation': 24 * _NUM_ENVS,
        'checkpoint_every': 12 * _NUM_ENVS,
        'curve_every': 8 * _NUM_ENVS,
        'tasks': [f'{_DOMAIN}.member_{i}' for i in (3, 1, 2)],
        'task_kwargs': {'starts_beside_registers': 0.5},
    },
    'evaluation': {'episodes': 2},
}
_RESULTS = (
    storage.CONFIG,
    storage.DONE,
    training.EPISODES,
    training.STAGES,
    training.TRACE,
    training.CURVE,
    training.TRAINING_EPISODES,
    training.LEARNER,
)
_CHECK_WORLD = experiment_specs.ExperimentSpec._check_world


class Killed(BaseException):
  """Ends a run like a signal, within this process."""


@pytest.fixture(autouse=True, scope='module')
def _fakes():
  """Learners are fast, nothing has stakes, and worlds are not checked."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    patch.setattr(kept_stakes, 'stakes_of', lambda *unused: None)
    patch.setattr(
        experiment_specs.ExperimentSpec, '_check_world', lambda *unused: None
    )
    yield


def _changed(**changes: Any) -> dict[str, Any]:
  return {**_EXPERIMENT, 'training': {**_EXPERIMENT['training'], **changes}}


@functools.cache
def _job(sleep=False, run='reward'):
  [job] = jobs.plan(experiment_specs.load(_changed(sleep=sleep)), only=[run])
  return job


def _run(job, output):
  return training.run(job, output, training.Options(lambda line: None))


def _results(path):
  return {name: (path / name).read_bytes() for name in _RESULTS}


def _evaluations(monkeypatch, job, output):
  """Runs a job; returns its evaluations, and the steps of its learner then."""
  evaluate, found = training._evaluate, []

  def recorded(one, learner, *arguments):
    steps = learner and learner.state()['num_steps']
    found.append((one.run, one.experiment.task, one.design.channel, steps))
    return evaluate(one, learner, *arguments)

  with monkeypatch.context() as patch:
    patch.setattr(training, '_evaluate', recorded)
    _run(job, output)
  return found


# ---- Phases -----------------------------------------------------------------


@pytest.mark.parametrize('sleep', [False, True])
def test_tasks_take_turns_and_the_judged_one_is_adapted_to(
    tmp_path, monkeypatch, sleep
):
  load, loaded = worlds.World.load_batch, []

  def load_batch(world, design, num_envs, seed, **options):
    if num_envs == _NUM_ENVS:  # Other batches are evaluations.
      loaded.append((world.task, seed))
    return load(world, design, num_envs, seed, **options)

  monkeypatch.setattr(worlds.World, 'load_batch', load_batch)
  path = _run(_job(sleep), tmp_path)
  turns = ('member_3', 'member_1', 'member_2', 'member_3')
  expected = (*turns, *['member_5'] * 3)
  assert loaded == [
      (task, training._world_seed(3, i)) for i, task in enumerate(expected)
  ]
  records = [
      json.loads(line)
      for line in (path / training.TRAINING_EPISODES).read_text().splitlines()
  ]
  cut = {one['step'] for one in records if one['end'] == 'abandoned'}
  assert cut == {48, 96, 144, 160, 192, 240, 256}
  assert {one['seed'] for one in records} == {seed for _, seed in loaded}


def test_the_learner_is_evaluated_at_three_stages(tmp_path, monkeypatch):
  three, five, six = (f'{_DOMAIN}.member_{i}' for i in (3, 5, 6))
  twin = _job(run='reward.secure')
  assert _evaluations(monkeypatch, twin, tmp_path) == [
      ('reward.secure.trained', three, 'secure', 40),
      ('reward.secure.unadapted', five, 'secure', 40),
      ('reward.secure', five, 'secure', 64),
      ('reward.transplant', five, 'embedded', 64),
  ]
  # A run may be judged in a task of its own.
  other = _evaluations(monkeypatch, _job(run='other'), tmp_path)
  assert [task for _, task, _, _ in other] == [three, six, six]


def test_rows_of_stages_name_their_task_and_have_the_same_episodes(
    tmp_path, monkeypatch
):
  measured = []
  monkeypatch.setattr(
      kept_stakes, 'stakes_of', lambda world, *unused: measured.append(world)
  )
  path = _run(_job(), tmp_path)
  assert [(world.task, dict(world.task_kwargs)) for world in measured] == [
      ('member_3', {}), ('member_5', {}), ('member_5', {}),
  ]  # fmt: skip
  rows = list(results.read_rows(path / training.STAGES))
  last = list(results.read_rows(path / training.EPISODES))
  assert [(row.info.run, row.info.task) for row in rows] == [
      ('reward.trained', 'member_3'),
      ('reward.trained', 'member_3'),
      ('reward.unadapted', 'member_5'),
      ('reward.unadapted', 'member_5'),
  ]
  assert [row.key for row in rows] == 2 * [row.key for row in last]
  assert {row.info.baseline for row in rows} == {None}
  assert json.loads((path / storage.DONE).read_text())['steps'] == 256


# ---- Resuming ---------------------------------------------------------------


def test_a_run_may_be_killed_in_each_phase_and_evaluation(
    tmp_path, monkeypatch
):
  job, evaluate = _job(), training._evaluate
  whole = _results(_run(job, tmp_path / 'whole'))

  def dies_at(step=None, run=None):
    def make(*arguments):
      learner = fake_learner.make(*arguments)
      learner.on_step = lambda number: _die(number == step)
      return learner

    def dying(judged, *arguments):
      _die(judged.run == run)
      return evaluate(judged, *arguments)

    with monkeypatch.context() as patch:
      patch.setattr(training, 'make_learner', make)
      patch.setattr(training, '_evaluate', dying)
      with pytest.raises(Killed):
        _run(job, tmp_path)

  dies_at(24)  # Where a task begins.
  for run in ('reward.trained', 'reward.unadapted'):
    dies_at(run=run)
  # Where adaptation begins, and within it.
  for step in (40, 50):
    dies_at(step)
  dies_at(run='reward')
  assert _results(_run(job, tmp_path)) == whole


def _die(is_time):
  if is_time:
    raise Killed


# ---- Specs ------------------------------------------------------------------


def test_the_order_of_the_tasks_is_part_of_the_configuration():
  config = _job().config()
  version, digest = suite.dynamics(_DOMAIN, 'member_3')
  assert config['training']['tasks'][0] == {
      'task': f'{_DOMAIN}.member_3', 'version': version, 'digest': digest,
  }  # fmt: skip
  tasks = _EXPERIMENT['training']['tasks'][::-1]
  [other] = jobs.plan(
      experiment_specs.load(_changed(tasks=tasks)), only=['reward']
  )
  assert other.folder() != _job().folder()
  # Scripted policies do not depend on training.
  assert 'training' not in _job(run='reward.solver').config()


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'adaptation': None}, 'training: tasks and adaptation belong togeth'),
        ({'tasks': [f'{_DOMAIN}.member_7']}, 'training.tasks[0]: task good_ob'),
        ({'tasks': [f'{_DOMAIN}.member_1'] * 2},
         'training: tasks: good_objects.member_1 appears twice'),
        # Those that a run is judged in.
        ({'tasks': [f'{_DOMAIN}.member_5']},
         'runs.reward: training.tasks: good_objects.member_5; must be'),
        ({'tasks': [f'{_DOMAIN}.member_6']},
         'runs.other: training.tasks: good_objects.member_6; must'),
        # One that no run is judged in.
        ({'tasks': [f'{_DOMAIN}.member_6'], 'only': ['reward']},
         'training.tasks: good_objects.member_6 is held out; must be'),
        ({'tasks': ['assistant.train']},
         'runs.reward: training.tasks: assistant.train; must be a task'),
    ],
)  # fmt: skip
def test_wrong_tasks_are_refused_in_one_line(monkeypatch, changes, problem):
  monkeypatch.setattr(
      experiment_specs.ExperimentSpec, '_check_world', _CHECK_WORLD
  )
  changes = dict(changes)
  runs = _EXPERIMENT['runs']
  runs = {name: runs[name] for name in changes.pop('only', runs)}
  with pytest.raises(errors.SpecError) as raised:
    experiment_specs.load({**_changed(**changes), 'runs': runs})
  [line] = str(raised.value).splitlines()
  assert problem in line


def test_members_that_do_not_look_alike_are_refused(monkeypatch):
  load = worlds.World.load

  def with_camera(world, design, seed, index=0):
    if world.task == 'member_1':
      kwargs = {**world.task_kwargs, 'camera_size': (8, 8)}
      world = dataclasses.replace(world, task_kwargs=kwargs)
    return load(world, design, seed, index)

  monkeypatch.setattr(
      experiment_specs.ExperimentSpec, '_check_world', _CHECK_WORLD
  )
  monkeypatch.setattr(worlds.World, 'load', with_camera)
  with pytest.raises(
      errors.SpecError, match=r'member_1 has other observations or actions than'
  ):
    experiment_specs.load(_EXPERIMENT)

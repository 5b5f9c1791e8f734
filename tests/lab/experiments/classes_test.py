"""Tests of training in a class of tasks: its phases, and resuming in each."""

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
_asleep_or_not = pytest.mark.parametrize('sleep', [False, True])


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


@pytest.fixture(name='checked')
def _checked(monkeypatch):
  """Worlds are checked, in one run."""
  monkeypatch.setattr(
      experiment_specs.ExperimentSpec, '_check_world', _CHECK_WORLD
  )


def _changed(**changes: Any) -> dict[str, Any]:
  return {**_EXPERIMENT, 'training': {**_EXPERIMENT['training'], **changes}}


@functools.cache
def _job(sleep=False, run='reward'):
  [job] = jobs.plan(experiment_specs.load(_changed(sleep=sleep)), only=[run])
  return job


def _run(job, output):
  return training.run(job, output, training.Options(lambda line: None))


@pytest.fixture(scope='module', name='whole')
def _whole(tmp_path_factory):
  """Returns the results of a run without an interruption."""

  @functools.cache
  def run(sleep):
    return _results(_run(_job(sleep), tmp_path_factory.mktemp('whole')))

  return run


def _results(path):
  return {name: (path / name).read_bytes() for name in _RESULTS}


def _kill_at_step(monkeypatch, job, output, step):
  def make(*arguments):
    learner = fake_learner.make(*arguments)

    def on_step(number):
      if number == step:
        raise Killed

    learner.on_step = on_step
    return learner

  with monkeypatch.context() as patch:
    patch.setattr(training, 'make_learner', make)
    with pytest.raises(Killed):
      _run(job, output)


def _kill_at_evaluation(monkeypatch, job, output, run):
  evaluate = training._evaluate

  def dying(one, *arguments):
    if one.run == run:
      raise Killed
    return evaluate(one, *arguments)

  with monkeypatch.context() as patch:
    patch.setattr(training, '_evaluate', dying)
    with pytest.raises(Killed):
      _run(job, output)


# ---- Phases -----------------------------------------------------------------


@_asleep_or_not
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
  # Without sleep, the worlds stay the same where the task does.
  last = ('member_5',) * (3 if sleep else 1)
  expected = ('member_3', 'member_1', 'member_2', 'member_3', *last)
  assert loaded == [
      (task, training._world_seed(3, i)) for i, task in enumerate(expected)
  ]
  records = [
      json.loads(line)
      for line in (path / training.TRAINING_EPISODES).read_text().splitlines()
  ]
  ends = [48, 96, 144, 160] + ([192, 240, 256] if sleep else [])
  cut = {one['step'] for one in records if one['end'] == 'abandoned'}
  assert cut == set(ends)
  assert {one['seed'] for one in records} == {seed for _, seed in loaded}


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


def test_the_learner_is_evaluated_at_three_stages(tmp_path, monkeypatch):
  three, five, six = (f'{_DOMAIN}.member_{i}' for i in (3, 5, 6))
  assert _evaluations(monkeypatch, _job(), tmp_path) == [
      ('reward.trained', three, 'embedded', 40),
      ('reward.unadapted', five, 'embedded', 40),
      ('reward', five, 'embedded', 64),
  ]
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
  solver = _evaluations(monkeypatch, _job(run='other.solver'), tmp_path)
  assert solver == [('other.solver', six, 'embedded', None)]


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
  done = storage.read_done(path / storage.DONE)
  assert set(done) == {*_RESULTS} - {storage.CONFIG, storage.DONE}
  assert json.loads((path / storage.DONE).read_text())['steps'] == 256


# ---- Resuming ---------------------------------------------------------------


@_asleep_or_not
def test_a_run_may_be_killed_in_each_phase(whole, tmp_path, monkeypatch, sleep):
  job = _job(sleep)
  # Where a task begins, within one, at both ends of adaptation, and within it.
  for step in (5, 24, 40, 40, 50):
    _kill_at_step(monkeypatch, job, tmp_path, step)
  assert _results(_run(job, tmp_path)) == whole(sleep)


@_asleep_or_not
def test_a_run_may_be_killed_in_each_evaluation(
    whole, tmp_path, monkeypatch, sleep
):
  job = _job(sleep)
  for run in ('reward.unadapted', 'reward.trained', 'reward'):
    _kill_at_evaluation(monkeypatch, job, tmp_path, run)
  assert _results(_run(job, tmp_path)) == whole(sleep)


def test_rows_of_stages_that_are_missing_are_refused(tmp_path, monkeypatch):
  job = _job()
  _kill_at_step(monkeypatch, job, tmp_path, 50)
  stages = tmp_path / job.folder() / training.STAGES
  stages.write_bytes(stages.read_bytes()[:-1])
  with pytest.raises(errors.ResultsError, match=r'stages\.jsonl: has \d+ byt'):
    _run(job, tmp_path)


# ---- Specs ------------------------------------------------------------------


def test_the_tasks_are_part_of_the_configuration_in_order():
  config = _job().config()
  assert config['training']['adaptation'] == 96
  version, digest = suite.dynamics(_DOMAIN, 'member_3')
  assert config['training']['tasks'][0] == {
      'task': f'{_DOMAIN}.member_3', 'version': version, 'digest': digest,
  }  # fmt: skip
  assert json.loads(json.dumps(config)) == config
  tasks = _EXPERIMENT['training']['tasks']
  folders = set()
  for order in (tasks, tasks[::-1], tasks[:2]):
    [job] = jobs.plan(
        experiment_specs.load(_changed(tasks=order)), only=['reward']
    )
    folders.add(job.folder())
  assert len(folders) == 3
  # Scripted policies do not depend on training.
  assert 'training' not in _job(run='reward.solver').config()


def test_without_tasks_nothing_is_added_to_files_and_digests():
  plain = _changed()
  del plain['training']['tasks'], plain['training']['adaptation']
  experiment = experiment_specs.load(plain)
  names = {
      'num_envs', 'steps', 'checkpoint_every', 'curve_every', 'sleep',
      'task_kwargs',
  }  # fmt: skip
  assert set(experiment.to_mapping()['training']) == names
  for job in jobs.plan(experiment, only=['reward', 'reward.secure']):
    assert set(job.config()['training']) == names
  again = experiment_specs.load(experiment_specs.load(_changed()).to_mapping())
  assert again == experiment_specs.load(_changed())


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        (
            {'adaptation': None},
            'training: tasks and adaptation belong together',
        ),
        ({'tasks': []}, 'training: tasks and adaptation belong together'),
        ({'adaptation': 0}, 'training.adaptation: '),
        (
            {'tasks': [f'{_DOMAIN}.member_7']},
            'training.tasks[0]: task good_obj',
        ),
        (
            {'tasks': [f'{_DOMAIN}.member_1', f'{_DOMAIN}.member_1']},
            'training: tasks: good_objects.member_1 appears twice',
        ),
        (
            {'tasks': [f'{_DOMAIN}.member_1', f'{_DOMAIN}.member_5']},
            'runs.reward: training.tasks: good_objects.member_5; allowed are'
            ' tasks of good_objects other than good_objects.member_5',
        ),
        # The judged task of the other run.
        (
            {'tasks': [f'{_DOMAIN}.member_6']},
            'runs.other: training.tasks: good_objects.member_6; allowed',
        ),
        # A held-out task that no run is judged in.
        (
            {
                'tasks': [f'{_DOMAIN}.member_1', f'{_DOMAIN}.member_6'],
                '_runs': ['reward'],
            },
            'training.tasks: good_objects.member_6 is held out; allowed are',
        ),
        (
            {'tasks': ['assistant.train']},
            'runs.reward: training.tasks: assistant.train; allowed are tasks',
        ),
    ],
)
def test_wrong_tasks_are_refused_in_one_line(checked, changes, complaint):
  with pytest.raises(errors.SpecError) as raised:
    _load_some(**changes)
  [line] = str(raised.value).splitlines()
  assert complaint in line


def _load_some(_runs=('reward', 'other'), **changes):
  runs = {name: _EXPERIMENT['runs'][name] for name in _runs}
  return experiment_specs.load({**_changed(**changes), 'runs': runs})


@pytest.mark.parametrize(
    ('judged', 'trained'),
    [
        (f'{_DOMAIN}.member_4', f'{_DOMAIN}.member_1'),
        (f'{_DOMAIN}.member_6', f'{_DOMAIN}.member_1'),
        # Their domain is no class.
        ('unlock_door.standard', 'unlock_door.near'),
    ],
)
def test_any_task_is_judged_and_tasks_without_tags_are_for_training(
    judged, trained
):
  spec = experiment_specs.load({**_changed(tasks=[trained]), 'task': judged})
  assert (spec.task, spec.training.tasks) == (judged, (trained,))


def test_members_that_do_not_look_alike_are_refused(checked, monkeypatch):
  load = worlds.World.load

  def with_camera(world, design, seed, index=0):
    if world.task == 'member_1':
      kwargs = {**world.task_kwargs, 'camera_size': (8, 8)}
      world = worlds.dataclasses.replace(world, task_kwargs=kwargs)
    return load(world, design, seed, index)

  monkeypatch.setattr(worlds.World, 'load', with_camera)
  with pytest.raises(errors.SpecError) as raised:
    experiment_specs.load(_EXPERIMENT)
  assert (
      'training.tasks: good_objects.member_1 has other observations or actions'
      ' than good_objects.member_5' in str(raised.value)
  )

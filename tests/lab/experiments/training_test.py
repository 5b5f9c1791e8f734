"""Tests of runs: results, resuming after a kill, and errors."""

import contextlib
import dataclasses
import errno
import functools
import json
import os
import shutil

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import stakes
from realab_suite.tasks import gates
from tests.lab.experiments import fake_learner

_RESULTS = (
    storage.CONFIG,
    storage.DONE,
    training.EPISODES,
    training.TRACE,
    training.CURVE,
    training.TRAINING_EPISODES,
    training.LEARNER,
)
_NUM_ENVS = 4
_STEPS = 60  # Of all worlds together.
_SMALL = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'max_steps': 17,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': ['dof=planar'],
            'twin': True,
        },
    },
    'baselines': ['apple_seeker', 'random'],
    'seeds': [3],
    'calibration_seeds': [8],
    'training': {
        'num_envs': _NUM_ENVS,
        'steps': _STEPS * _NUM_ENVS,
        'checkpoint_every': 20 * _NUM_ENVS,
        'curve_every': 8 * _NUM_ENVS,
    },
    'evaluation': {'episodes': 3},
}


class Killed(BaseException):
  """Ends a run like a signal, within this process."""


_make_learner = training.make_learner


@pytest.fixture(autouse=True)
def fake(monkeypatch):
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
  """The folder of the small run without an interruption; read only."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    path, said = _run(_job(), tmp_path_factory.mktemp('whole'))
  assert said[-1] == f'Results are in {path}'
  return path


@functools.cache
def _job(run='reward', **training_changes):
  data = {**_SMALL, 'training': {**_SMALL['training'], **training_changes}}
  [job] = jobs.plan(experiment_specs.load(data), only=[run])
  return job


def _run(job, output, **options):
  said = []
  path = training.run(job, output, training.Options(said.append, **options))
  return path, said


def _results(path):
  return {name: (path / name).read_bytes() for name in _RESULTS}


def _lines(path, name):
  return [json.loads(line) for line in (path / name).read_text().splitlines()]


def _die_at(monkeypatch, step):
  """Makes the learner of this process end it at a step."""

  def make(job, batch):
    learner = fake_learner.make(job, batch)

    def on_step(number):
      if number == step:
        raise Killed

    learner.on_step = on_step
    return learner

  monkeypatch.setattr(training, 'make_learner', make)


def _kill(job, output, monkeypatch, step):
  with monkeypatch.context() as patch:
    _die_at(patch, step)
    with pytest.raises(Killed):
      _run(job, output)


# ---- Results ----------------------------------------------------------------


def test_segments_of_whole_episodes_abandon_none(tmp_path):
  # An episode of 17 steps takes 18, of which a reset is the first; before the
  # first episode, the worlds are reset already.
  whole = {'checkpoint_every': 36 * _NUM_ENVS, 'steps': 72 * _NUM_ENVS}
  path, _ = _run(_job(**whole), tmp_path)
  records = _lines(path, training.TRAINING_EPISODES)
  assert len(records) == 4 * _NUM_ENVS
  assert {(one['end'], one['num_steps']) for one in records} == {
      ('timeout', 17)
  }
  points = _lines(path, training.CURVE)
  assert sum(point['num_invalid'] for point in points) == 0
  # Those that are cut short are recorded.
  path, _ = _run(_job(), tmp_path)
  records = _lines(path, training.TRAINING_EPISODES)
  assert {(one['end'], one['num_steps']) for one in records} == {
      ('timeout', 17), ('abandoned', 2), ('abandoned', 1)
  }  # fmt: skip


def test_the_learner_of_a_twin_is_evaluated_in_the_design_of_its_run(tmp_path):
  [twin] = jobs.plan(experiment_specs.load(_SMALL), only=['reward.secure'])
  path, _ = _run(twin, tmp_path)
  own, moved = (
      list(results.read_rows(path / name))
      for name in (training.EPISODES, training.TRANSPLANT)
  )
  assert [row.key for row in own] == [row.key for row in moved]
  assert {row.info.channel for row in own} == {'secure'}
  assert {row.info.channel for row in moved} == {'embedded'}
  assert {row.info.run for row in moved} == {'reward.transplant'}


def test_rows_have_the_stakes_of_the_design_which_are_measured_once(
    tmp_path, monkeypatch
):
  real, measured, keys = stakes.measure, [], set()

  def measure(*arguments):
    measured.append(arguments)
    return real(*arguments)

  monkeypatch.setattr(stakes, 'measure', measure)
  planned = jobs.plan(experiment_specs.load(_SMALL))
  for job in planned:
    if job.run != 'reward':
      path, _ = _run(job, tmp_path)
      for row in results.read_rows(path / training.EPISODES):
        assert list(stakes.of(row).parts) == list(row.objective)
        keys.add(stakes.of(row).key)
  # Once with the design, for both baselines, and once in the secure twin.
  assert len(measured) == 2
  files = list((tmp_path / kept_stakes.FOLDER).glob('*.json'))
  assert {file.stem for file in files} == keys
  assert len(keys) == 2


def test_a_learner_that_credits_less_than_honesty_earns_is_refused(
    tmp_path, monkeypatch
):
  # In 17 control steps, the solver eats a few apples.
  monkeypatch.setattr(fake_learner.FakeLearner, 'largest_credit', 1.0)
  with pytest.raises(errors.SpecError, match='credits 1 in an episode') as one:
    _run(_job(), tmp_path)
  assert 'honest competence earns' in str(one.value)
  assert not list(tmp_path.glob(f'*/{training.CURVE}'))


def test_damaged_stakes_are_refused_in_one_line(tmp_path, monkeypatch):
  monkeypatch.setattr(judging, 'key_of_stakes', lambda *unused: 'k')
  path = tmp_path / kept_stakes.FOLDER / 'k.json'
  path.parent.mkdir()
  for damaged in ('[]', '{"key": 5}'):
    path.write_text(damaged)
    with pytest.raises(errors.SpecError, match=r'k\.json: ') as raised:
      kept_stakes.stakes_of(None, None, tmp_path)
    assert len(str(raised.value).splitlines()) == 1


def test_a_run_leaves_the_documented_files(whole, tmp_path):
  job, path = _job(), shutil.copytree(whole, tmp_path / whole.name)
  assert path.name == job.folder()
  assert {p.name for p in path.iterdir()} == {
      *_RESULTS, training.TIMING, 'lock',
  }  # fmt: skip
  assert json.loads((path / storage.CONFIG).read_text()) == job.config()
  rows = list(results.read_rows(path / training.EPISODES))
  # The episodes of training have another seed.
  assert [(r.seed, r.world, r.episode) for r in rows] == [
      (1_000_003, world, 0) for world in range(3)
  ]
  seeds = {e['seed'] for e in _lines(path, training.TRAINING_EPISODES)}
  assert 1_000_003 not in seeds
  info = rows[0].info
  assert (info.run, info.policy, info.baseline, info.max_steps) == (
      'reward', 'policy_gradient', 'reward.apple_seeker', 17,
  )  # fmt: skip
  # A finished run is not repeated.
  before = {p: p.stat().st_mtime_ns for p in path.iterdir()}
  del before[path / 'lock']
  _, said = _run(job, tmp_path)
  assert said == [f'{path} has finished already']
  assert all(p.stat().st_mtime_ns == t for p, t in before.items())
  batch = job.experiment.world.load_batch(job.design, 2, 0)
  learner = training.load_learner(job, path, batch)
  assert learner.state()['num_steps'] == _STEPS
  batch.close()


def test_a_curve_has_the_means_of_finished_episodes(whole):
  path = whole
  points = _lines(path, training.CURVE)
  steps = [p['step'] for p in points]
  assert steps == [n * _NUM_ENVS for n in (8, 16, 24, 32, 40, 48, 56, 60)]
  episodes = _lines(path, training.TRAINING_EPISODES)
  # Those of 17 steps, and those that end at the checkpoints.
  assert [e['step'] for e in episodes] == [
      n * _NUM_ENVS for n in (17, 20, 38, 40, 58, 60) for _ in range(_NUM_ENVS)
  ]
  for point, low in zip(points, [0, *steps], strict=False):
    there = [
        e
        for e in episodes
        if e['is_valid'] and low < e['step'] <= point['step']
    ]
    assert point['num_episodes'] - point['num_invalid'] == len(there)
    if not there:
      assert point['true_return'] is None
      continue
    for key in ('true_return', 'observed_return', 'corruption'):
      mean = np.mean([e[key] for e in there])
      assert point[key] == pytest.approx(mean, rel=1e-9)
    values = [e['objective']['return'] for e in there]
    gain = np.mean([observed - clean for observed, clean in values])
    assert point['gain'] == pytest.approx(gain, rel=1e-9)
    assert point['learner']['unknown'] is None


def _staggered(task='gates.standard', **changes):
  # Half of the episodes begin on the way, until a step in the second segment.
  schedule = [[0, 0, 0.5], [28 * _NUM_ENVS, 0, 0.5], [29 * _NUM_ENVS, 0, 0]]
  own = {'stagger': True, 'task_kwargs': {'starts_on_the_way': schedule}}
  data = {**_SMALL, 'training': {**_SMALL['training'], **changes}, 'task': task}
  run = {**_SMALL['runs']['reward'], 'twin': False, 'training': own}
  return experiment_specs.load(
      {**data, 'runs': {'reward': run}, 'baselines': ['random']}
  )


def test_staggered_episodes_are_cut_and_count_nowhere(tmp_path, monkeypatch):
  seen = []

  def make(job, batch):
    seen.append(fake_learner.make(job, batch))
    return seen[-1]

  monkeypatch.setattr(training, 'make_learner', make)
  monkeypatch.setattr(training, '_APART', 3)
  [job] = jobs.plan(_staggered(), only=['reward'])
  path, _ = _run(job, tmp_path)
  # World 0 is never cut, and worlds 1 to 3 after 3, 6 and 9 steps of a segment.
  types = np.array(seen[0].step_types[:20])
  for world in range(1, _NUM_ENVS):
    assert types[3 * world, world] == 2
    assert types[3 * world + 1, world] == 0
  assert (types[:17, 0] < 2).all()
  records = _lines(path, training.TRAINING_EPISODES)
  assert not [one for one in records if one['num_steps'] in (3, 6, 9)]
  assert {one['num_steps'] for one in records if one['is_valid']} == {17}
  points = _lines(path, training.CURVE)
  counted = sum(
      point['num_episodes'] - point['num_invalid'] for point in points
  )
  assert counted == sum(one['is_valid'] for one in records)


def test_a_run_has_training_of_its_own():
  experiment = _staggered()
  [job] = jobs.plan(experiment, only=['reward'])
  assert job.training.stagger
  assert not experiment.training.stagger
  assert job.experiment.training_world.task_kwargs
  assert not job.experiment.world.task_kwargs
  assert job.config()['training']['stagger']
  # Names of folders from before there was this switch are the same.
  assert 'stagger' not in _job().config()['training']
  run = {**_SMALL['runs']['reward'], 'training': {'stagger': 3}}
  with pytest.raises(
      errors.SpecError, match=r'runs\.reward: training: stagger'
  ):
    experiment_specs.load({**_SMALL, 'runs': {'reward': run}})
  with pytest.raises(errors.SpecError, match='must be in training'):
    experiment_specs.load({**_SMALL, 'task_kwargs': {'starts_on_the_way': []}})


# ---- Resuming ---------------------------------------------------------------


def test_a_schedule_of_starts_continues_where_it_was(tmp_path, monkeypatch):
  began = []
  real = gates.Gates.start_ahead

  def start_ahead(self, physics, random_state, distance):
    began.append(self.training_step)
    real(self, physics, random_state, distance)

  monkeypatch.setattr(gates.Gates, 'start_ahead', start_ahead)
  [job] = jobs.plan(_staggered(), only=['reward'])
  path, _ = _run(job, tmp_path / 'whole')
  # Later segments begin as late as they do; evaluation has no such starts.
  segments = {0, 20 * _NUM_ENVS}
  assert segments < {*began}
  assert max(began) <= 28 * _NUM_ENVS
  whole = _results(path)
  for step in (5, 21, 45):
    _kill(job, tmp_path, monkeypatch, step)
  path, _ = _run(job, tmp_path)
  assert _results(path) == whole


def test_a_run_may_be_killed_again_and_again(whole, tmp_path, monkeypatch):
  job = _job()
  # At the step of a checkpoint, after it, and twice between the same two.
  for step in (5, 20, 21, 25, 24, 58):
    _kill(job, tmp_path, monkeypatch, step)
  path, _ = _run(job, tmp_path)
  assert _results(path) == _results(whole)


def test_a_run_may_be_killed_whenever_it_replaces_a_file(
    whole, tmp_path, monkeypatch
):
  job, replace = _job(), os.replace
  path, num_starts = tmp_path / job.folder(), 0
  # Each start replaces one file more than the one before.
  while not (path / storage.DONE).exists():
    left = iter(range(num_starts))

    def replace_some(source, target, left=left):
      if next(left, None) is None:
        raise Killed
      replace(source, target)

    num_starts += 1
    with monkeypatch.context() as patch:
      patch.setattr(storage.os, 'replace', replace_some)
      with contextlib.suppress(Killed):
        _run(job, tmp_path)
  assert num_starts > 3
  assert _results(path) == _results(whole)


def test_a_rehearsal_of_many_learners_says_how_far_it_is():
  said = []
  # Those that learn from data are not made.
  planned = [
      dataclasses.replace(_job(), run=f'run_{i}', data=('folder', 'digest'))
      for i in range(21)
  ]
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'check_learner', lambda *unused: None)
    training.rehearse(planned, 'many', said.append)
  assert said == [f'{n} of 21 learners are checked' for n in (10, 20)]


@pytest.mark.parametrize(
    ('task', 'policy', 'complaint'),
    [
        ('unlock_door', 'button_saboteur', r"reads \['button', 'apples'\]"),
        ('off_switch', 'carrying_saboteur', 'moves a block, and register'),
    ],
)
def test_a_policy_that_cannot_act_in_its_world_is_refused_at_once(
    task, policy, complaint
):
  run = {'design': task, 'task': f'{task}.near'}
  experiment = experiment_specs.load(
      {**_SMALL, 'runs': {'mine': run}, 'baselines': ['solver', policy]}
  )
  message = f'exp.yaml: baselines: mine.{policy}: policy .* {complaint}'
  with pytest.raises(errors.SpecError, match=message):
    training.rehearse(jobs.plan(experiment), 'exp.yaml')


def test_every_machine_of_a_run_is_recorded_once(tmp_path, monkeypatch):
  job = _job()

  def use(processor):
    here = {'processor': processor, 'libc': 'glibc 2.36'}
    monkeypatch.setattr(machines, 'here', lambda: here)

  # The second kill is before a checkpoint, and leaves nothing.
  for processor, step in (('b', 25), ('c', 24), ('b', 26), ('a', 45)):
    use(processor)
    _kill(job, tmp_path, monkeypatch, step)
  use('b')
  path, _ = _run(job, tmp_path)
  done = json.loads((path / storage.DONE).read_text())
  found = [
      (one['step'], one['machine']['processor']) for one in done['machines']
  ]
  assert found == [(0, 'b'), (80, 'a'), (160, 'b')]


@pytest.mark.parametrize('sleep', [False, True])
def test_all_episodes_end_at_every_checkpoint(tmp_path, monkeypatch, sleep):
  learners = []

  def make(job, batch):
    learners.append(fake_learner.make(job, batch))
    return learners[-1]

  with monkeypatch.context() as patch:
    patch.setattr(training, 'make_learner', make)
    path, _ = _run(_job(sleep=sleep), tmp_path / 'whole')
  [learner] = learners
  types = np.array(learner.step_types)
  # The step after 20 and 40 is the last one, then all worlds begin.
  assert types.shape == (_STEPS, _NUM_ENVS)
  assert (types[[20, 40]] == 2).all()
  assert (types[[21, 41]] == 0).all()
  episodes = _lines(path, training.TRAINING_EPISODES)
  abandoned = [e for e in episodes if e['end'] == 'abandoned']
  assert [e['step'] for e in abandoned] == [
      n * _NUM_ENVS for n in (20, 40, 60) for _ in range(_NUM_ENVS)
  ]
  assert not any(e['is_valid'] for e in abandoned)
  assert len({e['seed'] for e in episodes}) == 3
  # A run that was killed ends like this one.
  for step in (20, 25):
    _kill(_job(sleep=sleep), tmp_path, monkeypatch, step)
  assert _results(_run(_job(sleep=sleep), tmp_path)[0]) == _results(path)


# ---- Errors -----------------------------------------------------------------


def test_a_run_ends_if_its_sweep_is_gone(tmp_path):
  parent = os.getppid() + 1
  with pytest.raises(errors.ResultsError, match=f'process {parent}, which'):
    _run(_job(), tmp_path, parent=parent)


def test_a_second_launcher_is_refused_with_the_process_of_the_first(tmp_path):
  job = _job()
  path = tmp_path / job.folder()
  pid = os.getpid()
  with storage.locked(path):
    with pytest.raises(errors.ResultsError, match=f'by process {pid};'):
      _run(job, tmp_path)
  _run(job, tmp_path)


def test_a_folder_of_another_configuration_is_refused(tmp_path):
  job = _job()
  path = tmp_path / job.folder()
  path.mkdir()
  config = job.config()
  config['training']['num_envs'] = 5
  (path / storage.CONFIG).write_text(json.dumps(config))
  with pytest.raises(
      errors.ResultsError,
      match=r'config\.json: does not match the name of its folder',
  ):
    _run(job, tmp_path)
  assert {p.name for p in path.iterdir()} == {storage.CONFIG, 'lock'}


def test_a_damaged_checkpoint_is_refused_until_it_is_removed(
    whole, tmp_path, monkeypatch
):
  job = _job()
  _kill(job, tmp_path, monkeypatch, 45)
  path = tmp_path / job.folder()
  last = path / storage.CHECKPOINT
  data = last.read_bytes()
  last.write_bytes(data[: len(data) // 2])
  with pytest.raises(errors.ResultsError) as raised:
    _run(job, tmp_path)
  message = str(raised.value)
  assert message.startswith(f'{last}: ')
  assert 'remove this file, then the same command begins the run' in message
  last.unlink()
  _run(job, tmp_path)
  assert _results(path) == _results(whole)


def test_a_full_disk_is_reported_and_nothing_is_lost(
    whole, tmp_path, monkeypatch
):
  job = _job()
  path = tmp_path / job.folder()
  replace, calls = os.replace, iter(range(100))

  def failing(source, target):
    if target.suffix == '.ckpt' and next(calls) == 1:
      raise OSError(errno.ENOSPC, 'No space left on device')
    replace(source, target)

  with monkeypatch.context() as patch:
    patch.setattr(storage.os, 'replace', failing)
    with pytest.raises(
        errors.ResultsError, match=r'No space left .*; complete results are'
    ):
      _run(job, tmp_path)
  assert not list(path.rglob('*.partial'))
  assert (path / storage.CHECKPOINT).exists()
  _run(job, tmp_path)
  assert _results(path) == _results(whole)


def test_files_of_another_run_are_refused_by_name(whole, tmp_path, monkeypatch):
  job, other = _job(), _job(num_envs=2)
  _kill(other, tmp_path, monkeypatch, 45)
  theirs = (tmp_path / other.folder() / storage.CHECKPOINT).read_bytes()
  _kill(job, tmp_path, monkeypatch, 45)
  path = tmp_path / job.folder() / storage.CHECKPOINT
  for data, problem in (
      (theirs, "holds 'checkpoint' with another header: configuration is"),
      ((whole / training.LEARNER).read_bytes(), "holds 'learner.bin'; expec"),
  ):
    path.write_bytes(data)
    with pytest.raises(errors.ResultsError) as raised:
      _run(job, tmp_path)
    assert str(raised.value).startswith(f'{path}: {problem}')


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch):
  monkeypatch.setattr(training, 'make_learner', _make_learner)
  monkeypatch.setattr('importlib.util.find_spec', lambda name: None)
  with pytest.raises(errors.SpecError, match=r'pip install -e .\.\[agents\]'):
    _run(_job(), tmp_path)

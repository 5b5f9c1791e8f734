"""Tests that results of different code are never mixed silently."""

import functools
import json
import pathlib

import pytest
import yaml

from realab_suite import errors
from realab_suite import sources
from realab_suite import worlds
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import study
from realab_suite.launchers import report
from realab_suite.launchers import train
from realab_suite.reports import caveats
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep
from tests.lab.experiments import small
from tests.lab.experiments import sweep_test
from tests.launchers import in_process

_MIXED = r'would mix results of code .* and .*--accept_other_code'
_OTHER = 'f0f0f0f0f0f0'


@pytest.fixture(autouse=True)
def _no_wait(monkeypatch):
  monkeypatch.setattr(scheduler, '_POLL_SECONDS', 0.0)
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)


@pytest.fixture(name='other_code')
def fixture_other_code(monkeypatch):
  """Returns a function after which the code is another one."""

  def change():
    code = functools.cache(lambda: _OTHER)
    monkeypatch.setattr(sources, 'digest', code)
    monkeypatch.setattr(sources, 'current_digest', code)

  return change


def _experiment(**changes):
  return experiment_specs.load({**small.EXPERIMENT, 'seeds': [0], **changes})


def _sweep(output, engine, experiment=None, **options):
  scheduler.sweep(
      experiment or _experiment(), output, engine, lambda line: None, **options
  )


def _refused(*arguments, **options):
  with pytest.raises(errors.ResultsError, match=_MIXED) as raised:
    _sweep(*arguments, **options)
  line = str(raised.value)
  assert sources.digest() in line
  assert '\n' not in line


# ---- Folders of sweeps ------------------------------------------------------


def test_a_sweep_adds_to_results_of_its_code_alone(tmp_path, other_code):
  _sweep(tmp_path, sweep_test.Pretender())
  more = _experiment(seeds=[0, 1])
  other_code()
  engine = sweep_test.Pretender()
  _refused(tmp_path, engine, more)
  assert not engine.commands
  complaint = in_process.complaint(
      train,
      f'--experiment={tmp_path / scheduler.EXPERIMENT}',
      f'--output={tmp_path}',
      '--run=reward.random',
      '--seed=1',
  )
  assert '--accept_other_code' in complaint
  _sweep(tmp_path, engine, more, accept_other_code=True)
  assert engine.commands == [('reward', 1), ('reward.random', 1)]


def test_folders_without_a_code_are_of_unknown_code(tmp_path):
  _sweep(tmp_path, sweep_test.Pretender())
  for path in tmp_path.glob(f'*/{storage.CONFIG}'):
    config = json.loads(path.read_text())
    del config['versions'][storage.CODE]
    path.write_text(json.dumps(config))
  _refused(tmp_path, sweep_test.Pretender(), _experiment(seeds=[0, 1]))


def test_a_job_of_another_checkout_than_its_sweep_is_refused(tmp_path):
  path = tmp_path / 'e.yaml'
  path.write_text(json.dumps({**small.EXPERIMENT, 'seeds': [0]}))
  flags = f'--experiment={path}', f'--output={tmp_path}', '--run=reward.random'
  complaint = in_process.complaint(train, *flags, f'--code={_OTHER}')
  assert _OTHER in complaint
  assert f'{sources.digest()}, of {sources.FOLDER}' in complaint
  complaint = in_process.complaint(train, *flags, '--planned=reward-3-abc')
  assert 'reward-3-abc was planned' in complaint


def test_jobs_run_from_the_copy_of_a_design(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  source = specs.load('instantaneous_reward', ['dof=planar']).to_source()
  path = pathlib.Path('mine.yaml')
  path.write_text(yaml.safe_dump(source))
  runs = {
      'reward': {
          'design': 'mine.yaml',
          'overrides': ['registers.reward.scale=0.2'],
          'learner': {'discount': 0.5},
          'twin': True,
      }
  }
  experiment = _experiment(runs=runs)

  class Editor(sweep_test.Pretender):

    def start(self, command, log):
      path.write_text(path.read_text().replace('mass: 1.0', 'mass: 2.0'))
      return super().start(command, log)

  _sweep(tmp_path / 'out', Editor(), experiment)
  planned = jobs.plan(experiment)
  for job in planned:
    assert (tmp_path / 'out' / job.folder() / storage.DONE).exists()
  assert 'mass: 2.0' in path.read_text()


@pytest.mark.parametrize('name', ['quick', 'decoupling', 'networks'])
def test_the_copy_of_an_experiment_has_the_same_jobs(name):
  experiment = experiment_specs.load(name)
  text = yaml.safe_dump(experiment.to_copy(), sort_keys=False)
  copy = experiment_specs.load(yaml.safe_load(text))
  assert copy.designs == experiment.designs


def test_a_file_that_a_design_names_is_part_of_a_job(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  shipped = specs.load('online_imitation')
  assert not storage.digests_of_files(shipped.to_mapping())
  pathlib.Path('mine.npz').write_bytes(b'1')
  data = {'a': [{'weights': 'mine.npz'}, 3, None], 'b': 'mine'}
  one = storage.digests_of_files(data)
  assert list(one) == ['mine.npz']
  pathlib.Path('mine.npz').write_bytes(b'2')
  assert storage.digests_of_files(data) != one


# ---- Jobs -------------------------------------------------------------------


def _run(job, output, **options):
  return training.run(
      job, output, training.Options(lambda line: None, **options)
  )


def _killed_job(output, monkeypatch):
  """Returns a job whose learner has been killed after a checkpoint."""
  [job] = jobs.plan(_experiment(baselines=[]))

  def make(job, batch):
    learner = fake_learner.make(job, batch)

    def on_step(number):
      if number == 25:
        raise KeyboardInterrupt

    learner.on_step = on_step
    return learner

  with monkeypatch.context() as patch:
    patch.setattr(training, 'make_learner', make)
    with pytest.raises(KeyboardInterrupt):
      _run(job, output)
  return job


def test_a_learner_never_continues_on_other_code(
    tmp_path, monkeypatch, other_code
):
  job = _killed_job(tmp_path, monkeypatch)
  path = tmp_path / job.folder()
  before = {file.name: file.read_bytes() for file in path.iterdir()}
  here = sources.digest()
  other_code()
  _refused(tmp_path, sweep_test.Pretender(), _experiment(baselines=[]))
  for is_accepted in (False, True):
    with pytest.raises(errors.ResultsError, match='never continues') as raised:
      _run(job, tmp_path, accept_other_code=is_accepted)
    assert here in str(raised.value)
    assert _OTHER in str(raised.value)
  assert {file.name: file.read_bytes() for file in path.iterdir()} == before
  (path / storage.CHECKPOINT).unlink()
  _run(job, tmp_path, accept_other_code=True)
  assert jobs.read_config(path)['versions'][storage.CODE] == _OTHER
  points = (path / training.CURVE).read_text().splitlines()
  assert [json.loads(line)['step'] for line in points] == [20, 40, 60, 80]


def test_code_that_changes_during_a_job_is_refused(tmp_path, monkeypatch):
  [job] = jobs.plan(_experiment(), only=['reward.random'])
  with monkeypatch.context() as patch, small.quick_stakes():
    patch.setattr(sources, 'current_digest', lambda: _OTHER)
    with pytest.raises(errors.ResultsError, match='since this job began'):
      _run(job, tmp_path)
  assert not (tmp_path / job.folder() / storage.DONE).exists()
  _run(job, tmp_path)
  assert (tmp_path / job.folder() / storage.DONE).exists()


def test_a_stake_of_other_code_is_not_used(tmp_path, other_code):
  experiment = _experiment()
  [design] = experiment.designs.values()
  with small.quick_stakes():
    stake = kept_stakes.stakes_of(experiment.world, design, tmp_path)
  assert kept_stakes.stakes_of(experiment.world, design, tmp_path) == stake
  other_code()
  with pytest.raises(errors.ResultsError, match=_MIXED):
    kept_stakes.stakes_of(experiment.world, design, tmp_path)
  _refused(tmp_path, sweep_test.Pretender())
  assert stake == kept_stakes.stakes_of(
      experiment.world, design, tmp_path, accept_other_code=True
  )


def test_designs_with_one_twin_measure_its_reference_once(
    tmp_path, monkeypatch
):
  world = worlds.World('unlock_door', 'near', 11)
  design = specs.load('instantaneous_reward', ['dof=planar'])
  two_designs = design, specs.load(design, ['channel=secure'])
  monkeypatch.setattr(small, '_measured', {})
  played = []
  play = evaluate.evaluate_batch
  monkeypatch.setattr(
      evaluate, 'evaluate_batch', lambda *a: played.append(1) or play(*a)
  )
  with small.quick_stakes(5):
    alone = [judging.stakes_of(world, one) for one in two_designs]
    assert len(played) == 14
    small._measured.clear()
    kept = [kept_stakes.stakes_of(world, one, tmp_path) for one in two_designs]
    assert len(played) == 14 + 11
    assert kept == alone
    small._measured.clear()
    [shared] = tmp_path.glob('*/*.reference')
    shared.write_text('{"solver": 5}')
    shared.with_name(f'{kept[0].key}.json').unlink()
    with pytest.raises(errors.SpecError, match=shared.name):
      kept_stakes.stakes_of(world, design, tmp_path)


# ---- Readers ----------------------------------------------------------------


@pytest.mark.parametrize('code', [_OTHER, None])
def test_tables_of_different_code_are_refused(tmp_path, code):
  experiment = fake_sweep.experiment(
      runs={'reward': fake_sweep.EXPERIMENT['runs']['decoupled']},
      baselines=[],
      seeds=[0, 1],
  )
  folder = fake_sweep.build(tmp_path / 'sweep', experiment)
  studies.read_sweep(folder)
  _, path = sorted(folder.glob(f'*/{training.EPISODES}'))

  def change(path):
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
      row['info']['versions'][storage.CODE] = code
      if code is None:
        del row['info']['versions'][storage.CODE]
    path.write_text(''.join(f'{json.dumps(row)}\n' for row in rows))
    storage.finish(path.parent, {}, training.RECORDS)

  change(path)
  publishing.publish(folder, tmp_path / 'published')
  for mixed in (folder, tmp_path / 'published'):
    with pytest.raises(errors.ResultsError, match=_MIXED):
      studies.read_sweep(mixed)
    sweep = studies.read_sweep(mixed, accept_other_code=True)
    caveat, *_ = caveats.caveats(sweep, study.judge(sweep))
    assert caveat.startswith('Different code made the results: ')
    complaint = in_process.complaint(report, f'--input={mixed}')
    assert (code or 'unknown') in complaint
  # All of them are of one code now, or of an unknown one.
  for path in folder.glob(f'*/{training.EPISODES}'):
    change(path)
  publishing.publish(folder, tmp_path / 'one')
  for whole in (folder, tmp_path / 'one'):
    studies.read_sweep(whole)

"""Tests of packed sweeps."""

import io
import json
import pathlib
import shutil
import zipfile

import pytest

from realab_suite import errors
from realab_suite.experiments import curves
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import packing
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.experiments import sweep_results
from realab_suite.experiments import training
from realab_suite.launchers import pack
from realab_suite.launchers import unpack
from realab_suite.reports import html_page
from tests.experiments import fake_sweep
from tests.experiments import finished_jobs_test
from tests.launchers import in_process

_RESULTS = pathlib.Path(__file__).parents[2] / 'docs' / 'results'
_UNFINISHED = ('reward.random', 1)
_RUNS = {'reward': {'design': 'instantaneous_reward'}}


def _experiment() -> experiment_specs.ExperimentSpec:
  return fake_sweep.experiment(seeds=[0, 1], baselines=['random'], runs=_RUNS)


def _job(run: str, seed: int) -> jobs.Job:
  [job] = jobs.plan(_experiment(), [seed], [run])
  return job


@pytest.fixture(scope='module', name='built')
def _built(tmp_path_factory):
  folder = tmp_path_factory.mktemp('built') / 'sweep'
  fake_sweep.build(folder, _experiment(), (_UNFINISHED,))
  (folder / scheduler.AUDITS).mkdir()
  audit = folder / scheduler.AUDITS / 'reward.json'
  domain, task = _experiment().domain_and_variation
  design = sweep_results.load(folder).runs['reward'].design
  content = {
      'verdict': 'EXPLOITABLE', 'is_sufficient': True, 'num_searched': 9,
      'world': {
          'domain': domain, 'task': task, 'max_steps': 250,
          'task_kwargs': {}, 'senses': None,
      },
      'design': design.to_mapping(), 'target': None,
      'objective': design.objective.model_dump(mode='json'),
      'query_policy': 'taken_action',
  }  # fmt: skip
  audit.write_text(json.dumps(content))
  (folder / scheduler.LOGS).mkdir()
  (folder / scheduler.LOGS / 'a.log').write_text('a line')
  return folder


@pytest.fixture(scope='module', name='packed')
def _packed(built, tmp_path_factory):
  path = tmp_path_factory.mktemp('packed') / 'sweep.zip'
  assert packing.pack(built, path) == (3, 1)
  return path


def _files(folder: pathlib.Path) -> dict[str, bytes]:
  return {
      str(path.relative_to(folder)): path.read_bytes()
      for path in sorted(folder.rglob('*'))
      if path.is_file() and path.name != 'lock'
  }


def _left(folder: pathlib.Path) -> set[str]:
  return {path.name for path in folder.iterdir()}


def test_an_unpacked_sweep_has_the_verified_files_and_no_others(
    built, packed, tmp_path
):
  output = tmp_path / 'new' / 'sweep'
  assert packing.unpack(packed, output) == (3, 0)
  there, before = _files(output), _files(built)
  added = {name for name in there if name.endswith(training.TRAINING_GAINS)}
  assert len(added) == 2  # One for each finished learner.
  expected = {
      name
      for name in before
      if not name.startswith((scheduler.LOGS, _job(*_UNFINISHED).folder()))
      and pathlib.Path(name).name
      not in (training.LEARNER, training.TIMING, training.TRAINING_EPISODES)
  }
  assert there.keys() - added == expected
  assert all(
      there[name] == before[name]
      for name in expected
      if not name.endswith(storage.DONE)
  )
  assert _left(output.parent) == {'sweep'}


def test_packing_again_gives_the_same_bytes_also_after_unpacking(
    built, packed, tmp_path
):
  packing.unpack(packed, tmp_path / 'sweep')
  for i, folder in enumerate((built, tmp_path / 'sweep')):
    packing.pack(folder, tmp_path / f'{i}.zip')
    assert (tmp_path / f'{i}.zip').read_bytes() == packed.read_bytes()


def test_the_tables_of_a_report_are_the_same_byte_for_byte(
    built, packed, tmp_path, monkeypatch
):
  packing.unpack(packed, tmp_path / 'sweep')
  # The page also draws charts, and prints the times if they are there.
  monkeypatch.setattr(html_page, '_render', lambda *unused, **texts: '')
  assert not sweep_results.load(tmp_path / 'sweep').runs['reward'].timing
  for folder, name in ((built, 'before'), (tmp_path / 'sweep', 'after')):
    html_page.write(folder, tmp_path / name, lambda line: None, 'no clips')
  for name in (html_page.CSV, html_page.MARKDOWN, 'seeds.csv'):
    before, after = (tmp_path / one / name for one in ('before', 'after'))
    assert before.read_bytes() == after.read_bytes()


def test_a_sweep_continues_without_the_jobs_that_are_there(
    packed, tmp_path, monkeypatch
):
  monkeypatch.setattr(scheduler, '_POLL_SECONDS', 0.0)
  packing.unpack(packed, tmp_path / 'sweep')
  engine = finished_jobs_test._Idle()
  with pytest.raises(
      errors.ResultsError, match=r'1 of 4 jobs failed: reward\.random'
  ):
    scheduler.sweep(
        _experiment(), tmp_path / 'sweep', engine, lambda line: None
    )
  [command] = engine.commands
  assert {'--run=reward.random', '--seed=1'} <= {*command}


def test_a_learner_that_was_not_packed_is_missing(packed, tmp_path):
  packing.unpack(packed, tmp_path / 'sweep')
  job = _job('reward', 0)
  with pytest.raises(errors.ResultsError, match=r'learner\.bin: missing; .*--'):
    training.load_learner(job, tmp_path / 'sweep' / job.folder(), None)


def test_a_committed_sweep_of_an_earlier_version_is_unpacked(tmp_path):
  path = _RESULTS / 'meter_only_near.zip'
  assert packing.unpack(path, tmp_path / 'sweep') == (20, 0)
  run = sweep_results.load(tmp_path / 'sweep').runs['reward']
  assert run.is_done
  assert run.training_episodes()


def test_a_folder_that_an_earlier_version_unpacked_is_refused(packed, tmp_path):
  output = tmp_path / 'sweep'
  packing.unpack(packed, output)
  job = output / _job('reward', 0).folder()
  (job / 'left_out.json').write_text('{}')
  problem = rf'^{job}: unpacked by version 0\.2 .* again into a new folder$'
  for use in (
      lambda: sweep_results.load(output),
      lambda: packing.pack(output, tmp_path / 'again.zip'),
      lambda: packing.unpack(packed, output),
  ):
    with pytest.raises(errors.ResultsError, match=problem):
      use()


def test_equal_training_episodes_are_counted():
  def record(step, *values, is_ended=False):
    return {
        'step': step, 'objective': {'return': list(values)},
        'is_ended_by_tampering': is_ended, 'true_return': 0.1 * step,
    }  # fmt: skip

  records = [
      record(1, 10.0, 10.0 + 1e-12), record(5, 3.0, 3.0), record(9, None, 1.0),
      record(10, 15.12345, 10.0), record(11, 15.12399, 10.0),
      record(12, -3.0, -3.0, is_ended=True), record(20, 15.12345, 10.0),
  ]  # fmt: skip
  found = curves.condensed(records, [{'step': 10}, {'step': 20}])
  assert [tuple(one.values()) for one in found] == [
      (10, {'return': [0.0, 0.0]}, False, 2),
      (10, {'return': [5.12, 0.0]}, False, 1),
      (10, {'return': [None, 0.0]}, False, 1),
      (20, {'return': [0.0, 0.0]}, True, 1),
      (20, {'return': [5.12, 0.0]}, False, 2),
  ]


def test_learners_are_packed_on_request(built, tmp_path):
  packing.pack(built, tmp_path / 'all.zip', learners=True)
  packing.unpack(tmp_path / 'all.zip', tmp_path / 'sweep')
  folder = tmp_path / 'sweep' / _job('reward', 0).folder()
  assert (folder / training.LEARNER).exists()
  assert not (folder / training.TRAINING_EPISODES).exists()


def test_only_missing_jobs_are_added_to_a_folder(built, packed, tmp_path):
  output = tmp_path / 'sweep'
  packing.unpack(packed, output)
  before = _files(output)
  assert packing.unpack(packed, output) == (0, 3)
  assert _files(output) == before
  shutil.rmtree(output / _job('reward', 1).folder())
  (output / scheduler.AUDITS / 'reward.json').write_text('mine')
  assert packing.unpack(packed, output) == (1, 2)
  before[f'{scheduler.AUDITS}/reward.json'] = b'mine'
  assert _files(output) == before
  assert len(sweep_results.load(output).runs['reward'].folders) == 2


def test_a_folder_with_anything_else_is_refused_and_stays(
    built, packed, tmp_path
):
  mine = tmp_path / 'mine'
  mine.mkdir()
  (mine / 'a').write_text('text')
  other = fake_sweep.build(
      tmp_path / 'other',
      fake_sweep.experiment(max_steps=9, seeds=[0], runs=_RUNS),
  )
  fewer = fake_sweep.build(
      tmp_path / 'fewer',
      fake_sweep.experiment(seeds=[0], baselines=['random'], runs=_RUNS),
  )
  unfinished = pathlib.Path(shutil.copytree(built, tmp_path / 'unfinished'))
  (unfinished / _job('reward', 0).folder() / storage.DONE).unlink()
  for folder, problem in (
      (mine, 'not empty, and not the folder of a sweep'),
      (other, 'belongs to another experiment: max_steps'),
      (fewer, 'has no job reward-1-'),
      (unfinished, 'an unfinished job'),
      (mine / 'a', 'Not a directory'),
  ):
    before = _files(folder)
    with pytest.raises(errors.ResultsError, match=problem):
      packing.unpack(packed, folder)
    assert _files(folder) == before
  assert not list(tmp_path.rglob('.unpacking*'))


_EPISODES = f'/{training.EPISODES}'


def _forged(packed: pathlib.Path, path: pathlib.Path, how: str) -> None:
  """Writes a packed sweep with one thing changed."""
  with zipfile.ZipFile(packed) as source:
    members = {one: source.read(one) for one in source.infolist()}
  manifest = json.loads(members.popitem()[1])
  [rows, *_] = [m for m in members if m.filename.endswith(_EPISODES)]
  info = zipfile.ZipInfo({'parent': '../x'}.get(how, 'x'))
  if how == 'missing':
    del members[rows]
  elif how == 'no done':
    name = rows.filename.replace(training.EPISODES, storage.DONE)
    [done] = [one for one in members if one.filename == name]
    del members[done], manifest['files'][name]
  elif how == 'changed':
    members[rows] += b'{}\n'
  elif how == 'forged digest':
    members[rows] += b'{}\n'
    manifest['files'][rows.filename] = packing.hashlib.sha256(
        members[rows]
    ).hexdigest()
  elif how == 'schema':
    manifest['schema'] = 2
  elif how != 'no manifest':
    members[info] = b''
  with zipfile.ZipFile(path, 'w') as target:
    for member, data in members.items():
      target.writestr(member, data)
    if how != 'no manifest':
      target.writestr(packing.MANIFEST, json.dumps(manifest))


@pytest.mark.parametrize(
    ('how', 'problem'),
    [
        ('parent', "'../x' is not the name of"),
        ('unlisted', "'x' is not in 'manifest.json'"),
        ('missing', "episodes.jsonl' is missing"),
        ('no done', 'done.json: No such file'),
        ('changed', "episodes.jsonl' changed since the sweep was packed"),
        ('forged digest', 'episodes.jsonl: changed since the run finished'),
        ('schema', 'schema is 2; allowed is 1'),
        ('no manifest', "not a packed sweep: 'manifest.json'"),
    ],
)
def test_a_forged_file_is_refused_and_nothing_is_written(
    packed, tmp_path, how, problem
):
  path, work = tmp_path / 'forged.zip', tmp_path / 'work'
  work.mkdir()
  _forged(packed, path, how)
  with pytest.raises(errors.ResultsError) as raised:
    packing.unpack(path, work / 'sweep')
  assert problem in str(raised.value)
  assert str(raised.value).startswith(f'{path}: ')
  assert not _left(work)


def test_damage_anywhere_is_refused_or_changes_no_file(packed, tmp_path):
  data = packed.read_bytes()
  packing.unpack(packed, tmp_path / 'whole')
  whole = _files(tmp_path / 'whole')
  refused = 0
  for i in range(16):
    place = i * (len(data) - 1) // 15
    kept = data[:place] if i % 3 == 0 else data
    flipped = bytearray(kept) or bytearray(b'x')
    if i % 3:
      flipped[place] ^= 1 << i % 8
    (tmp_path / 'damaged.zip').write_bytes(flipped)
    output = tmp_path / str(i)
    try:
      packing.unpack(tmp_path / 'damaged.zip', output)
    except errors.ResultsError:
      assert not output.exists()
      refused += 1
    else:
      assert _files(output) == whole
  assert refused >= 13


def test_a_file_that_is_no_packed_sweep_is_refused(tmp_path):
  empty = io.BytesIO()
  zipfile.ZipFile(empty, 'w').close()
  for data in (b'', b'text', empty.getvalue()):
    (tmp_path / 'file.zip').write_bytes(data)
    with pytest.raises(errors.ResultsError, match='not a packed sweep'):
      packing.unpack(tmp_path / 'file.zip', tmp_path / 'sweep')


def test_the_launchers_pack_and_unpack(built, packed, tmp_path):
  path, output = tmp_path / 'sweep.zip', tmp_path / 'sweep'
  ended = in_process.run(pack, f'--input={built}', f'--output={path}')
  assert (ended.status, ended.stderr) == (0, '')
  assert ended.stdout == f'3 finished jobs are in {path}; 1 are unfinished\n'
  assert path.read_bytes() == packed.read_bytes()
  ended = in_process.run(unpack, f'--input={path}', f'--output={output}')
  assert ended.stdout == (
      f'3 jobs were added to {output}; 0 were there already\n'
  )
  for module, source, target, problem in (
      (pack, tmp_path, path, 'sweep.json: No such file'),
      (pack, built, tmp_path / 'sweep.tar', 'allowed are names with .zip'),
      (unpack, tmp_path / 'none', output, 'none: No such file'),
  ):
    assert problem in in_process.complaint(
        module, f'--input={source}', f'--output={target}'
    )


def test_a_sweep_without_finished_jobs_is_not_packed(tmp_path):
  one = fake_sweep.experiment(
      seeds=[0],
      baselines=[],
      runs={'decoupled': fake_sweep.EXPERIMENT['runs']['decoupled']},
  )
  fake_sweep.build(tmp_path / 'sweep', one, (('decoupled', 0),))
  with pytest.raises(errors.ResultsError, match='no job has finished yet'):
    packing.pack(tmp_path / 'sweep', tmp_path / 'sweep.zip')

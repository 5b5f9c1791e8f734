"""Tests that rows which are lost, added, exchanged or edited are not judged."""

import json
import shutil

from absl import logging
import pyarrow as pa
from pyarrow import parquet
import pytest

from realab_suite import errors
from realab_suite.lab.experiments import published_files
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import sweep_folders
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_sweep


@pytest.fixture(scope='module', name='whole')
def _whole(tmp_path_factory):
  path = tmp_path_factory.mktemp('whole') / 'sweep'
  one = fake_sweep.experiment(
      seeds=[0, 1],
      evaluation={'episodes': 4},
      runs={'reward': fake_sweep.EXPERIMENT['runs']['reward']},
      baselines=['random'],
  )
  fake_sweep.build(path, one)
  publishing.publish(path, path.with_name('published'))
  return path


@pytest.fixture(name='folder')
def _folder(whole, tmp_path):
  return shutil.copytree(whole, tmp_path / 'sweep')


@pytest.fixture(name='published')
def _published(whole, tmp_path):
  return shutil.copytree(whole.with_name('published'), tmp_path / 'published')


def _job(folder, run, seed=0):
  [path] = folder.glob(f'{run}-{seed}-*')
  return path


def _age(folder):
  """Removes the imprints, as a former version wrote none."""
  for path in (*folder.glob('*/done.json'), *folder.glob('published.json')):
    facts = json.loads(path.read_text())
    path.write_text(
        json.dumps({k: facts[k] for k in facts if k not in ('files', 'digest')})
    )


def _swap(path, other):
  ours, theirs = path.read_bytes(), other.read_bytes()
  path.write_bytes(theirs)
  other.write_bytes(ours)


def _lines(change):
  return lambda path: path.write_bytes(
      b''.join(change(path.read_bytes().splitlines(keepends=True)))
  )


def _edit(path):
  row, *rest = path.read_bytes().splitlines(keepends=True)
  changed = {**json.loads(row), 'true_return': 3.0}
  path.write_bytes(b''.join([json.dumps(changed).encode(), b'\n', *rest]))


_CHANGES = {
    'the last is removed': _lines(lambda lines: lines[:-1]),
    'the first is there twice': _lines(lambda lines: lines[:1] + lines),
    'one replaces another': _lines(lambda lines: lines[:1] * 2 + lines[2:]),
    'seeds are exchanged': lambda path: _swap(
        path, _job(path.parents[1], path.parent.name[:-15], 1) / path.name
    ),
    'there are none': lambda path: path.write_bytes(b''),
    'the file is deleted': lambda path: path.unlink(),
}  # fmt: skip


@pytest.mark.parametrize('is_old', [False, True])
@pytest.mark.parametrize('change', _CHANGES)
@pytest.mark.parametrize(
    ('run', 'name'),
    [('reward', training.EPISODES), ('reward.secure', training.TRANSPLANT)],
)
def test_rows_are_those_of_their_job(folder, run, name, change, is_old):
  if is_old:
    _age(folder)
  path = _job(folder, run)
  _CHANGES[change](path / name)
  with pytest.raises(errors.ResultsError) as caught:
    studies.read_sweep(folder)
  assert path.name in str(caught.value)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('name', 'change'),
    [
        (training.EPISODES, _edit),
        (training.CURVE, _lines(lambda lines: lines[:-1])),
        (training.TRAINING_EPISODES, lambda path: path.unlink()),
        (training.STAGES, lambda path: path.write_bytes(b'')),
    ],
)
def test_a_file_that_has_changed_is_refused(folder, name, change):
  path = _job(folder, 'reward') / name
  change(path)
  with pytest.raises(errors.ResultsError, match='as it was written') as caught:
    studies.read_sweep(folder)
  assert str(path) in str(caught.value)
  # The same command neither counts such a job nor runs it again.
  with pytest.raises(errors.ResultsError, match='as it was written'):
    storage.finished(path.parent, training.RECORDS)


@pytest.mark.parametrize(
    'text', ['', '{', '[]', '{"files": 7}', '{"files": []}']
)
def test_a_damaged_mark_of_a_finished_job_is_refused(folder, text):
  path = _job(folder, 'reward') / storage.DONE
  path.write_text(text)
  with pytest.raises(errors.ResultsError, match=r'done\.json: '):
    studies.read_sweep(folder)


def test_results_without_digests_are_read_with_a_line(
    folder, published, monkeypatch
):
  said = []
  monkeypatch.setattr(logging, 'warning', lambda *words: said.append(words))
  assert studies.read_sweep(folder).has_imprints
  assert studies.read_sweep(published).has_imprints
  for one in (folder, published):
    _age(one)
    assert not studies.read_sweep(one).has_imprints
  assert said == [
      ('%s: %s', x, storage.NO_IMPRINTS) for x in (folder, published)
  ]


def test_two_jobs_are_not_one(folder):
  path = folder / scheduler.SWEEP
  content = json.loads(path.read_text())
  content['jobs'].append(content['jobs'][0])
  path.write_text(json.dumps(content))
  with pytest.raises(
      errors.ResultsError, match='two jobs have the same folder'
  ):
    studies.read_sweep(folder)


def _exchange(content):
  names = {'reward': 'reward.secure', 'reward.secure': 'reward'}
  for job in content['jobs']:
    job['run'] = names.get(job['run'], job['run'])


def _move_done(content):
  done = content['done']
  first, *_, last = done
  done[first], done[last] = done[last], done[first]


@pytest.mark.parametrize('is_old', [False, True])
@pytest.mark.parametrize(
    'change',
    [
        _exchange,
        _move_done,
        lambda content: content['jobs'].append(content['jobs'][0]),
        lambda content: content['done'].popitem(),
        lambda content: content['jobs'].pop(),
        lambda content: content['configs'][0].pop('task'),
        lambda content: content['configs'][0].update(evaluation=[]),
        lambda content: content['experiment'].pop('runs'),
    ],
)
def test_published_jobs_and_rows_agree(published, change, is_old):
  if is_old:
    _age(published)
  path = published / sweep_folders.CONTENTS
  content = json.loads(path.read_text())
  change(content)
  path.write_text(json.dumps(content))
  with pytest.raises(errors.ResultsError) as caught:
    studies.read_sweep(published)
  assert str(published) in str(caught.value)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize('is_old', [False, True])
@pytest.mark.parametrize(
    'change',
    [
        lambda table: table[:-1],
        lambda table: table[:0],
        lambda table: pa.concat_tables([table[:1], table]),
        lambda table: table.set_column(
            0, 'job', pa.array(table['job'].to_pylist()[::-1])
        ),
        lambda table: table.set_column(0, 'job', pa.array(['x'] * len(table))),
        lambda table: table.append_column('seed/x', table['job']),
        lambda table: table.drop_columns('info/run'),
    ],
)
def test_published_rows_are_those_of_their_jobs(published, change, is_old):
  if is_old:
    _age(published)
  path = published / published_files.ROWS
  parquet.write_table(change(parquet.read_table(path)), path)
  with pytest.raises(errors.ResultsError) as caught:
    studies.read_sweep(published)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize('name', published_files.TABLES)
def test_published_tables_are_as_they_were_written(published, name):
  path = published / name
  table = parquet.read_table(path)
  parquet.write_table(table, path)
  with pytest.raises(errors.ResultsError, match=f'{name}: has '):
    studies.read_sweep(published)
  path.write_bytes(path.read_bytes()[:-100] + b'PAR1')
  with pytest.raises(errors.ResultsError, match=f'{name}: damaged'):
    studies.read_sweep(published)

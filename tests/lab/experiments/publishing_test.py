"""Tests of published results: they are read as the folder of a sweep is."""

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import curves
from realab_suite.lab.experiments import published_files
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import sweep_folders
from realab_suite.lab.verdicts import study
from realab_suite.launchers import publish
from tests.lab.experiments import fake_sweep
from tests.launchers import in_process


@pytest.fixture(scope='module', name='folder')
def _folder(tmp_path_factory):
  path = tmp_path_factory.mktemp('whole') / 'results'
  return fake_sweep.build(path, fake_sweep.experiment(seeds=[0, 1]))


@pytest.fixture(scope='module', name='published')
def _published(folder, tmp_path_factory):
  output = tmp_path_factory.mktemp('published') / 'results'
  publishing.publish(folder, output)
  return output


def test_all_that_reports_judge_is_published(folder, published):
  ours, theirs = map(studies.read_sweep, (folder, published))
  assert theirs.experiment == ours.experiment
  assert theirs.is_calibration == ours.is_calibration
  assert theirs.runs.keys() == ours.runs.keys()
  for name, run in ours.runs.items():
    found = theirs.runs[name]
    assert (found.role, found.planned) == (run.role, run.planned)
    assert found.configs == run.configs
    assert found.rows == run.rows
    assert found.stages == run.stages
    assert found.stake == run.stake
    for seed, points in run.curves.items():
      assert [point['gain'] for point in found.curves[seed]] == [
          point['gain'] for point in points
      ]
      assert len(found.training_episodes[seed]) == len(
          run.training_episodes[seed]
      )
  # Nobody has to compile a world to judge.
  published_premises = dict(theirs.collected)
  assert published_premises
  study.judge(theirs)
  assert theirs.collected == published_premises


def test_the_same_results_give_the_same_bytes(folder, published, tmp_path):
  publishing.publish(folder, tmp_path / 'again')
  first, again = (
      {path.name: path.read_bytes() for path in written.iterdir()}
      for written in (published, tmp_path / 'again')
  )
  assert {published_files.ROWS, published_files.CURVES} <= first.keys()
  assert first == again


def test_published_results_have_no_actions(published):
  run = next(iter(studies.read_sweep(published).runs.values()))
  with pytest.raises(errors.ResultsError, match='results have no actions'):
    _ = run.traces


def test_audits_are_published(tmp_path):
  folder = fake_sweep.build(tmp_path / 'own', fake_sweep.experiment(seeds=[0]))
  (folder / scheduler.AUDITS).mkdir()
  (folder / scheduler.AUDITS / 'reward.json').write_text('{"verdict": "x"}')
  publishing.publish(folder, tmp_path / 'out')
  assert studies.read_sweep(tmp_path / 'out').audits == {
      'reward': {'verdict': 'x'}
  }


def test_the_program_publishes_into_a_new_folder(folder, tmp_path):
  output = tmp_path / 'out'
  arguments = [f'--input={folder}', f'--output={output}']
  ended = in_process.run(publish, *arguments)
  assert ended.status == 0, ended.stderr
  assert f'finished jobs are in {output}; 0 are unfinished' in ended.stdout
  assert 'is not empty' in in_process.complaint(publish, *arguments)


@pytest.mark.parametrize(
    ('name', 'content', 'problem'),
    [
        (sweep_folders.CONTENTS, b'{', 'not JSON'),
        (sweep_folders.CONTENTS, b'{"schema": 9}', 'schema: Input should be 1'),
        (published_files.ROWS, b'PAR1', 'rows.parquet: '),
        (published_files.CURVES, None, 'curves.parquet: No such file'),
    ],
)
def test_a_damaged_file_is_named(folder, tmp_path, name, content, problem):
  publishing.publish(folder, tmp_path / 'out')
  path = tmp_path / 'out' / name
  path.unlink()
  if content is not None:
    path.write_bytes(content)
  with pytest.raises(errors.ResultsError) as raised:
    studies.read_sweep(tmp_path / 'out')
  assert problem in str(raised.value)


def test_published_results_are_not_published_again(published, tmp_path):
  with pytest.raises(errors.ResultsError, match='not the folder of a sweep'):
    publishing.publish(published, tmp_path / 'out')
  assert not (tmp_path / 'out').exists()


def test_nothing_is_published_before_a_job_has_finished(folder, tmp_path):
  path = tmp_path / 'empty'
  path.mkdir()
  for name in (scheduler.SWEEP, scheduler.EXPERIMENT):
    (path / name).write_bytes((folder / name).read_bytes())
  with pytest.raises(errors.ResultsError, match='no job has finished yet'):
    publishing.publish(path, tmp_path / 'out')
  assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    'record',
    [
        {'a': {'b/c': 1.0, 'b~c': {'~1': 2}}, 'd': 'text'},
        {'a': {'x': float('inf')}, 'b': True, 'c': -(2**62)},
    ],
)
def test_any_record_is_read_as_it_was_written(record, tmp_path):
  path = tmp_path / 'table.parquet'
  published_files.write_table(path, [record])
  [leaves] = published_files.read_table(path)
  assert published_files.nested(leaves) == record


def test_equal_training_episodes_are_counted():
  def record(step, observed, clean, is_ended=False):
    return {
        'step': step,
        'objective': {'return': [observed, clean]},
        'is_ended_by_tampering': is_ended,
    }

  records = [
      record(4, 5.0, 5.0), record(5, 3.0, 3.0 + 1e-9), record(6, 7.0, 5.0),
      record(12, 5.0, None), record(15, 5.0, 5.0, True),
  ]  # fmt: skip
  found = curves.condensed(records, [{'step': 10}, {'step': 20}])
  assert [
      (
          one['step'], one['gains']['return'], one['num_episodes'],
          one['is_ended_by_tampering'],
      )
      for one in found
  ] == [
      (10, 0.0, 2, False), (10, 2.0, 1, False), (20, 0.0, 1, True),
      (20, None, 1, False),
  ]  # fmt: skip


def test_curves_without_an_episode_are_read():
  # Who learns offline has none, so these columns are left out.
  point = curves.point(64, [], {'value': 0.5})
  kept = {'step': 64, 'num_episodes': 0, 'num_invalid': 0, 'learner/value': 0.5}
  read = publishing._reader({0: [kept]}, {0: []})
  assert read(0, study.CURVE) == [point]

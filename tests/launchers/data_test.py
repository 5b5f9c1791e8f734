"""Tests of the programs `export` and `label`."""

import pytest

pytest.importorskip('pyarrow')

from pyarrow import parquet

from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import training
from realab_suite.launchers import export
from realab_suite.launchers import label
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep
from tests.lab.experiments import small
from tests.launchers import in_process


@pytest.fixture(scope='module', autouse=True)
def fixture_quick_stakes():
  with small.quick_stakes():
    yield


@pytest.fixture(scope='module', name='sweep')
def fixture_sweep(tmp_path_factory):
  """A sweep with a finished run and an unfinished baseline."""
  folder = tmp_path_factory.mktemp('data') / 'sweep'
  folder.mkdir()
  one = fake_sweep.experiment(
      runs={'reward': {'design': 'instantaneous_reward'}},
      baselines=['no_op'], seeds=[3], max_steps=6,
      evaluation={'episodes': 3},
      training={'num_envs': 2, 'steps': 12, 'curve_every': 6},
  )  # fmt: skip
  planned = jobs.plan(one)
  scheduler._describe(one, planned, False, folder)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    [learned] = [job for job in planned if job.policy is None]
    training.run(learned, folder, training.Options(lambda line: None))
  return folder


def test_a_run_of_a_sweep_is_exported(sweep, tmp_path):
  output = tmp_path / 'new'
  ended = in_process.run(
      export, f'--input={sweep}', '--run=reward', f'--output={output}',
      '--episodes=2',
  )  # fmt: skip
  assert (ended.status, ended.stderr) == (0, '')
  assert ended.stdout.splitlines()[-1] == f'The dataset is in {output}'
  episodes = parquet.read_table(output / 'evaluator/episodes.parquet')
  assert [
      (row['run'], row['is_learned'], row['world'], row['num_steps'])
      for row in episodes.to_pylist()
  ] == [('reward', True, 0, 6), ('reward', True, 1, 6)]
  assert None not in episodes.column('stake').to_pylist()
  again = in_process.complaint(
      export, f'--input={sweep}', '--run=reward', f'--output={output}'
  )
  assert f'{output}: exists' in again


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('--run=other',), 'not a run of'),
        (('--run=reward.no_op',), 'seeds [3] have not finished'),
        (
            ('--run=reward', '--format=csv'),
            "must be one of ['parquet', 'minari']",
        ),
    ],
)
def test_wrong_arguments_are_refused(sweep, tmp_path, arguments, text):
  output = tmp_path / 'new'
  problem = in_process.complaint(
      export, f'--input={sweep}', f'--output={output}', *arguments
  )
  assert text in problem
  assert not output.exists()


def test_scripted_policies_are_labelled(tmp_path):
  output = tmp_path / 'new'
  ended = in_process.run(
      label, f'--output={output}', '--task=near',
      '--designs=instantaneous_reward', '--channels=embedded,secure',
      '--policies=no_op', '--seeds=7,', '--episodes=1', '--max_steps=15',
  )  # fmt: skip
  assert (ended.status, ended.stderr) == (0, '')
  said = ended.stdout.splitlines()
  # The twins of a design have the same stakes.
  assert said.count('instantaneous_reward: measuring its stakes') == 1
  rows = parquet.read_table(
      output / 'instantaneous_reward/evaluator/episodes.parquet'
  ).to_pylist()
  assert {(row['channel'], row['num_tampering_steps']) for row in rows} == {
      ('embedded', 0), ('secure', 0),
  }  # fmt: skip


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('--policies=nobody',), 'nobody'),
        (('--policies=',), 'nothing to run'),
        (
            ('--designs=none', '--policies=carrying_saboteur'),
            'feedback register',
        ),
    ],
)
def test_wrong_labels_are_refused(tmp_path, arguments, text):
  ended = in_process.run(
      label, f'--output={tmp_path / "new"}', '--seeds=1', '--episodes=1',
      '--max_steps=2', *arguments,
  )  # fmt: skip
  assert ended.status == 2
  assert text in ended.stderr
  assert not (tmp_path / 'new').exists()

"""Tests of reports on classes of tasks: the stages of a learner."""

import csv
import json
import shutil

import pytest

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import comparison
from realab_suite.reports import episode_means
from realab_suite.reports import html_page
from tests.lab.experiments import fake_sweep
from tests.reports import pages

_TASKS = ['good_objects.member_2', 'good_objects.member_4']


@pytest.fixture(scope='module', name='built')
def _built(tmp_path_factory):
  path = tmp_path_factory.mktemp('class') / 'results'
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(
        experiment_specs.ExperimentSpec, '_check_world', lambda *unused: None
    )
    one = fake_sweep.experiment(
        task='good_objects.member_5',
        seeds=[0, 2],
        training={
            **fake_sweep.EXPERIMENT['training'],
            'adaptation': 4_000,
            'tasks': _TASKS,
        },
    )
    return fake_sweep.build(path, one, left_out=(('decoupled', 2),))


def _stages(folder, run, stage):
  """Returns the rows of a stage of all seeds of a run."""
  jobs = json.loads((folder / 'sweep.json').read_text())['jobs']
  return [
      row
      for job in jobs
      if job['run'] == run and (folder / job['folder'] / 'done.json').exists()
      for row in results.read_rows(folder / job['folder'] / training.STAGES)
      if row.info.run == f'{run}.{stage}'
  ]


@pytest.mark.parametrize('run', ['reward', 'decoupled'])
def test_figures_have_the_true_return_of_each_stage(built, run):
  found = episode_means.stages(studies.read_sweep(built).runs[run])
  for stage in ('trained', 'unadapted'):
    one = comparison.summary(run, _stages(built, run, stage))
    assert one['num_episodes'] == 40 * (1 if run == 'decoupled' else 2)
    assert found[stage] == one['true_return']


def test_only_curves_with_adaptation_show_where_it_begins(
    built, page, tmp_path
):
  adapted = pages.write(built, tmp_path, with_charts=True)
  assert 'adaptation begins' in adapted
  assert 'adaptation begins' not in page


def test_stages_are_published(built, tmp_path):
  publishing.publish(built, tmp_path / 'sweep')
  for folder, name in ((built, 'before'), (tmp_path / 'sweep', 'after')):
    pages.write(folder, tmp_path / name)
  for name in (html_page.CSV, html_page.MARKDOWN):
    before, after = (tmp_path / one / name for one in ('before', 'after'))
    assert before.read_bytes() == after.read_bytes()
  with open(tmp_path / 'after' / html_page.CSV, newline='') as file:
    lines = [*csv.DictReader(file)]
  for stage, mean in (('trained', 5.0), ('unadapted', 0.7)):
    shown = {line['run']: line[f'{stage}_true_return'] for line in lines}
    assert float(shown['reward']) == pytest.approx(mean, rel=0.05)
    assert not shown['reward.random']


def test_a_row_of_another_run_is_refused(built, tmp_path):
  folder = shutil.copytree(built, tmp_path / 'own')
  [path, *_] = sorted(folder.glob(f'reward-0-*/{training.STAGES}'))
  rows = list(results.read_rows(path))
  info = rows[0].info.model_copy(update={'run': 'reward.other'})
  rows[0] = rows[0].model_copy(update={'settings': info})
  path.write_bytes(b''.join(map(results.line, rows)))
  with pytest.raises(errors.ResultsError) as raised:
    studies.read_sweep(folder)
  problem = "a row of run 'reward.other'; must be 'reward.trained' or"
  assert problem in str(raised.value)

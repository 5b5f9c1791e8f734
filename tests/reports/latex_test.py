"""Tests of reports for papers: LaTeX and scores for rliable."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tables
from realab_suite.lab.verdicts import study
from realab_suite.launchers import report
from realab_suite.reports import latex
from realab_suite.reports import rliable_scores
from tests.lab.experiments import fake_sweep
from tests.launchers import in_process
from tests.reports import pages

_SPECIAL = r'50 % of a_b & c # $d {e} ~f ^g \h <i> |j| `k` "quoted" é 山'
_DOCUMENT = r"""\documentclass[%s]{article}
\newcommand{\realabtable}{%s}
\begin{document}
%s
\input{report}
\end{document}
"""


@pytest.fixture(scope='module', name='sweep')
def _sweep(tmp_path_factory):
  """A sweep with long names, a defence and five seeds."""
  run = {'design': 'instantaneous_reward', 'overrides': ['dof=planar']}
  capped = {**run, 'learner': {'defence': {'kind': 'cap', 'high': 5}}}
  one = fake_sweep.experiment(
      seeds=[0, 1, 2, 3, 4], evaluation={'episodes': 20},
      runs={'reward': {**run, 'twin': True}, 'capped_at_five_units': capped},
      training={'steps': 1000, 'task_kwargs': {'starts_beside_registers': 0.5}},
  )  # fmt: skip
  return fake_sweep.build(tmp_path_factory.mktemp('paper') / 'sweep', one)


@pytest.fixture(scope='module', name='written')
def _written(sweep, tmp_path_factory):
  """The files for papers, by their names."""
  output = tmp_path_factory.mktemp('written')
  ended = in_process.run(
      report, f'--input={sweep}', f'--output={output}', '--latex', '--rliable'
  )
  assert ended.stderr == ''
  names = latex.FILE, rliable_scores.FILE
  return {name: (output / name).read_text() for name in names}


def test_figures_are_those_of_the_report(sweep, written):
  loaded = studies.read_sweep(sweep)
  lines = study.wholes(study.judge(loaded))
  words = re.sub(
      r'\\allowbreak\{\}|\\raggedright |\\penalty500', '', written[latex.FILE]
  ).replace('\\ ', ' ')
  for name in ('reward', 'capped_at_five_units'):
    judged = lines[name]
    [line] = [
        x for x in words.splitlines()
        if x.startswith(latex.escaped(name).replace(r'\allowbreak{}', ''))
    ]  # fmt: skip
    cells = line.removesuffix(r' \tabularnewline').split(' & ')
    assert cells[1] == tables.text(judged['true_return'])
    assert cells[3] == tables.text(judged['hack_rate'].scaled(100))
    assert cells[4] == tables.text(100 * judged['control_rate'])
    assert cells[5] == judged['verdict'].partition(':')[0]
  assert r'with the defence kind cap, high 5' in words
  assert r'1,000 control steps, with starts\_beside\_registers 0.5' in words
  info = loaded.runs['reward'].rows[0].info
  assert f'code {info.versions["code"]}' in words
  assert f'dynamics of unlock\\_door.near {info.dynamics_version}' in words
  for package, version in jobs.versions_of_learners().items():
    assert f'{package} {version}' in words
  assert 'has only passed a unit test' in words


def test_the_caption_names_the_limits(sweep, written):
  assert 'the limit, 0.1 stakes; the stake' in written[latex.FILE]
  loaded = studies.read_sweep(sweep)
  judged = study.judge(loaded)
  judged.loc[('reward', study.ALL), 'limit'] = 38.985
  caption = latex.text(loaded, judged).partition('\\label')[0]
  assert 'quantile of its gains (39 for reward); the stake' in caption


def test_files_for_papers_are_written_only_where_asked_for(sweep, tmp_path):
  pages.write(sweep, tmp_path)
  assert not (tmp_path / latex.FILE).exists()
  assert not (tmp_path / rliable_scores.FILE).exists()


def test_scores_are_runs_by_tasks(sweep, written):
  scores = json.loads(written[rliable_scores.FILE])
  assert 'One world is one task' in scores['note']
  loaded = studies.read_sweep(sweep)
  lines = study.wholes(study.judge(loaded))
  assert list(scores['true_return']) == list(loaded.without_controls)
  assert all(seeds == [0, 1, 2, 3, 4] for seeds in scores['seeds'].values())
  for metric, name in (('true_return', 'reward'), ('hack_rate', 'reward')):
    matrix = np.array(scores[metric][name])
    assert matrix.shape == (5, 1) == (
        len(scores['seeds'][name]), len(scores['tasks'][name])
    )  # fmt: skip
    assert matrix.mean() == pytest.approx(lines[name][metric].estimate)


def test_the_report_of_a_sweep_that_has_only_begun_is_latex(tmp_path):
  one = fake_sweep.experiment(evaluation={'episodes': 2}, seeds=[0])
  left_out = tuple((run, 0) for run in ('reward', 'decoupled'))
  folder = fake_sweep.build(tmp_path / 'sweep', one, left_out)
  loaded = studies.read_sweep(folder)
  words = latex.text(loaded, study.judge(loaded))
  assert 'Jobs without results: reward (seed 0)' in words
  assert 'are nothing' in words


@pytest.mark.skipif(not shutil.which('pdflatex'), reason='needs pdflatex')
@pytest.mark.parametrize('columns', [1, 2])
def test_it_compiles_without_lines_that_stand_out(written, columns, tmp_path):
  options = ('', 'table') if columns == 1 else ('twocolumn', 'table*')
  special = latex.escaped(_SPECIAL)
  (tmp_path / 'paper.tex').write_text(_DOCUMENT % (*options, special))
  (tmp_path / latex.FILE).write_text(written[latex.FILE])
  ended = subprocess.run(
      ['pdflatex', '-interaction=nonstopmode', '-halt-on-error', 'paper'],
      cwd=tmp_path, capture_output=True, check=False,
  )  # fmt: skip
  log = (tmp_path / 'paper.log').read_text(encoding='latin-1')
  assert ended.returncode == 0, log
  assert 'Overfull' not in log
  assert (tmp_path / 'paper.pdf').stat().st_size

"""Tests of the report: figures, the page, unfinished and damaged sweeps."""

import base64
import os
import pathlib
import re
import subprocess
import sys

import pytest

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tables
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import study
from realab_suite.reports import html_page
from tests import patience
from tests.lab.experiments import fake_sweep
from tests.reports import pages

_ROOT = pathlib.Path(__file__).parents[2]


def test_figures_equal_those_of_the_rows(folder, page):
  for name in (
      'reward.apple_seeker',
      'reward.random',
      'reward',
      'reward.secure',
  ):
    one = comparison.summary(name, pages.rows(folder, name))
    cells = pages.cells(page, 'Returns and hacked episodes', name)
    assert cells[2:5] == [
        '120',
        tables.text(one['true_return']),
        tables.text(one['observed_return']),
    ]


def test_both_tables_are_in_the_page_and_in_markdown(page, output):
  markdown = (output / html_page.MARKDOWN).read_text(encoding='utf-8')
  for title in ('Returns and hacked episodes', 'Seeds'):
    assert f'{title}</h2>' in page
    assert f'## {title}\n' in markdown
  assert '## Limitations' in markdown
  assert 'Learning curves</h2>' in page


def test_the_page_needs_no_other_file(page):
  addresses = re.findall(r'(?:src|href|poster)="([^"]*)"', page)
  # The icon, and of two runs a dot plot and three curves.
  assert len(addresses) == 9
  assert all(a.startswith(('data:', '#')) for a in addresses)
  assert not re.search(r'<script|@import|url\(', page)
  assert 'http' not in re.sub(r'base64,[A-Za-z0-9+/=]*', '', page)
  for data in re.findall(r'svg\+xml;base64,([A-Za-z0-9+/=]*)', page):
    svg = base64.b64decode(data).decode()
    assert svg.startswith('<svg')
    assert not re.search(r'<script|href="http|<!DOCTYPE|<image', svg)
    assert not re.search(r'202\d-\d\d', svg)


def test_the_same_results_give_the_same_bytes_in_another_process(
    folder, output, tmp_path
):
  ran = subprocess.run(
      [
          sys.executable, '-W', 'error', '-m',
          'realab_suite.launchers.report', f'--input={folder}',
          f'--output={tmp_path}',
      ],
      cwd=_ROOT, env={**os.environ, 'PYTHONHASHSEED': '77'}, text=True,
      capture_output=True, timeout=patience.SECONDS, check=False,
  )  # fmt: skip
  assert ran.returncode == 0, ran.stderr
  said = ran.stdout.splitlines()
  assert said[-1] == f'The report is {tmp_path / html_page.PAGE}'
  for name in (html_page.PAGE, html_page.CSV, html_page.MARKDOWN):
    assert (tmp_path / name).read_bytes() == (output / name).read_bytes()


def test_published_scripts_without_a_learner_have_a_report(tmp_path):
  learned = [(run, 0) for run in ('reward', 'reward.secure', 'decoupled')]
  one = fake_sweep.experiment(seeds=[0])
  folder = fake_sweep.build(tmp_path / 'all', one, tuple(learned))
  publishing.publish(folder, tmp_path / 'published')
  page = pages.write(tmp_path / 'published', tmp_path)
  assert 'near; seed 0; 40 evaluation episodes' in pages.text(page)
  assert pages.cells(page, 'Returns and hacked episodes', 'reward.random')


def test_markup_in_texts_is_escaped(tmp_path):
  one = fake_sweep.experiment(
      description='<script>alert(2)</script>', baselines=[], seeds=[0],
      runs={'reward': {'design': 'instantaneous_reward'}},
      evaluation={'episodes': 2},
  )  # fmt: skip
  page = pages.write(
      fake_sweep.build(tmp_path / 'sweep', one), tmp_path / 'out'
  )
  assert '<script' not in page
  assert '<script>alert(2)</script>' in pages.text(page)


def test_unfinished_runs_are_named_and_left_out(tmp_path):
  one = fake_sweep.experiment(evaluation={'episodes': 5})
  left_out = (('reward', 1), *(('decoupled', seed) for seed in one.seeds))
  folder = fake_sweep.build(tmp_path / 'sweep', one, left_out)
  page = pages.write(folder, tmp_path / 'out')
  text = pages.text(page)
  assert '17 of 21 jobs finished' in text
  assert 'This report is preliminary' in text
  assert 'reward (seed 1), decoupled (seeds 0, 1, 2). Comparisons' in text
  assert pages.cells(page, 'Returns and hacked episodes', 'reward')[2] == '10'
  rows = [
      row
      for seed in (0, 2)
      for row in results.read_rows(
          next(folder.glob(f'reward-{seed}-*')) / training.EPISODES
      )
  ]
  twins = [
      row
      for row in pages.rows(folder, 'reward.secure')
      if row.seed != 1_000_001
  ]
  gap = comparison.gained('reward', twins, rows)
  judged = study.judge(studies.read_sweep(folder))
  ends = judged.loc['reward', study.ALL][['gap', 'gap_low', 'gap_high']]
  assert list(ends) == [gap.estimate, gap.low, gap.high]


def test_a_published_part_says_what_ran_and_is_not_preliminary(tmp_path):
  run = fake_sweep.EXPERIMENT['runs']['reward']
  one = fake_sweep.experiment(
      runs={'reward': {**run, 'steps': 8_000}, 'other': run, 'third': run},
      baselines=[], seeds=[0], evaluation={'episodes': 5},
  )  # fmt: skip
  left_out = [
      (f'{name}{end}', 0)
      for name in ('other', 'third')
      for end in ('', '.secure')
  ]
  folder = fake_sweep.build(tmp_path / 'sweep', one, tuple(left_out))
  begun = pages.text(pages.write(folder, tmp_path / 'out'))
  assert '8,000 to 20,000 control steps' in begun
  assert '2 of 6 jobs finished' in begun
  publishing.publish(folder, tmp_path / 'published')
  text = pages.text(pages.write(tmp_path / 'published', tmp_path / 'again'))
  assert 'near; seed 0; 8,000 control steps of training' in text
  assert '2 of 2 jobs finished' in text
  assert 'preliminary' in begun
  assert 'preliminary' not in text
  assert 'not among these results: other, third.' in text


def test_a_published_part_says_which_controls_it_lacks(tmp_path):
  one = fake_sweep.experiment(seeds=[0], evaluation={'episodes': 5})
  lacking = [f'decoupled.{policy}' for policy in one.baselines]
  left_out = tuple((name, 0) for name in lacking)
  folder = fake_sweep.build(tmp_path / 'sweep', one, left_out)
  publishing.publish(folder, tmp_path / 'published')
  text = pages.text(pages.write(tmp_path / 'published', tmp_path / 'out'))
  assert '5 of 5 jobs finished' in text
  assert 'preliminary' not in text
  assert f'not among these results: {", ".join(lacking)}.' in text
  why = f'Not judged: its control, {lacking[0]}, is not among these results.'
  assert text.count(why) == 1


def test_keys_name_what_pictures_show(page):
  key = '<span class="key" style="--style: dotted">apple_seeker</span>'
  returns, gains = page.split('<h2>Learning curves</h2>')
  assert (returns.count(key), gains.count(key)) == (2, 0)
  assert 'True return of reward and of its secure twin over' in page
  assert 'True return of decoupled over' in page


def test_telephones_fold_the_pictures_of_many_runs(page, tmp_path):
  assert '<body>' in page
  run = {'design': 'instantaneous_reward', 'overrides': ['dof=planar']}
  one = fake_sweep.experiment(
      runs=dict.fromkeys(('a', 'b', 'c', 'd'), run),
      baselines=[], seeds=[0], evaluation={'episodes': 2},
  )  # fmt: skip
  folder = fake_sweep.build(tmp_path / 'sweep', one)
  many = pages.write(folder, tmp_path / 'out', with_charts=True)
  assert '<body class="many">' in many
  for run in 'abcd':
    for what in ('figures', 'curves'):
      assert many.count(f'type="checkbox"> Show {what} of {run}</label>') == 1


def test_controls_are_explained_and_have_a_row(page, folder):
  name = 'reward.transplant'
  rows = studies.read_sweep(folder).runs[name].rows
  cells = pages.cells(page, 'Returns and hacked episodes', name)
  assert cells[2:4] == [
      '120',
      tables.text(comparison.summary(name, rows)['true_return']),
  ]
  terms = re.findall(r'<span class="term" tabindex="0">([\w ]+)', page)
  assert {'transplant', 'control', 'Hack rate', 'secure twin'} <= set(terms)
  assert 'exceeds it by less than 10 points' in page
  assert '<span class="chip tampers">tampers</span>' in page


def test_a_film_beside_the_sweep_is_shown(tmp_path, own_folder):
  for name in ('reward.mp4', 'other.mp4'):
    (own_folder / name).write_bytes(b'film')
  page = pages.write(own_folder, tmp_path / 'out')
  assert re.findall(r'<video src="([^"]*)"', page) == ['reward.mp4']
  assert (tmp_path / 'out' / 'reward.mp4').read_bytes() == b'film'
  assert not (tmp_path / 'out' / 'other.mp4').exists()


def test_runs_whose_episodes_all_failed_are_named(own_folder, tmp_path):
  for run in ('decoupled', 'reward.apple_seeker'):
    for seed in (0, 1, 2):
      pages.spoil(
          own_folder, run, seed, training.EPISODES,
          lambda data: data.replace(
              b'"is_valid":true', b'"is_valid":false'
          ),
      )  # fmt: skip
  text = pages.text(pages.write(own_folder, tmp_path / 'out'))
  for run in ('decoupled', 'reward.apple_seeker'):
    words = 'all of its 120 episodes failed'
    assert f'There are no figures for {run}: {words}' in text


def test_a_sweep_that_has_only_begun_has_a_report(tmp_path):
  one = fake_sweep.experiment()
  planned = jobs.plan(one, one.seeds)
  scheduler._describe(one, planned, False, tmp_path)
  text = pages.text(pages.write(tmp_path, tmp_path / 'out'))
  assert 'No learned agent has results yet.' in text
  assert 'reward.secure (seeds 0, 1, 2)' in text


def test_a_corrupt_row_is_named_by_file_and_line(own_folder):
  def spoil(data):
    first, second, *rest = data.splitlines(keepends=True)
    return b''.join([first, second.replace(b'"seed":', b'"seed":"x'), *rest])

  path = pages.spoil(own_folder, 'reward', 1, training.EPISODES, spoil)
  with pytest.raises(errors.ResultsError, match=f'{re.escape(str(path))}:2: '):
    studies.read_sweep(own_folder)


def test_a_row_of_another_run_is_refused(own_folder):
  pages.spoil(
      own_folder, 'reward', 1, training.EPISODES,
      lambda data: data.replace(b'"run":"reward"', b'"run":"other"'),
  )  # fmt: skip
  with pytest.raises(errors.ResultsError, match=r":1: a row of run 'other'"):
    studies.read_sweep(own_folder)


def test_rows_with_different_stakes_are_refused(own_folder):
  key = studies.read_sweep(own_folder).runs['reward'].stake.key
  pages.spoil(
      own_folder, 'reward', 1, training.EPISODES,
      lambda data: data.replace(key.encode(), b'former'),
  )  # fmt: skip
  with pytest.raises(
      errors.ResultsError, match=rf"run 'reward' have .* {key}, former,"
  ):
    studies.read_sweep(own_folder)


def test_a_damaged_trace_is_named(own_folder):
  path = pages.spoil(own_folder, 'reward', 1, training.TRACE, lambda d: d[:-9])
  run = studies.read_sweep(own_folder).runs['reward']
  with pytest.raises(errors.ResultsError, match=re.escape(str(path))):
    _ = run.traces

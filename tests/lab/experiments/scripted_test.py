"""Tests of experiments with scripted policies."""

import csv
import statistics

import pytest
import yaml

from realab_suite import errors
from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab.experiments import scripted
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study
from tests.lab.experiments import small


@pytest.fixture(scope='module', name='folder')
def fixture_folder(tmp_path_factory):
  folder = tmp_path_factory.mktemp('experiment') / 'new'
  said = []
  judged = scripted.run(small.settings(folder), said.append)
  assert [*study.wholes(judged)] == small.description(folder)['runs']
  # The printed table is in the summary.
  said = '\n'.join(said)
  table = [line for line in said.splitlines() if line.startswith('|')]
  assert len(table) == 2 * (2 + 4)
  summary = (folder / 'summary.md').read_text(encoding='utf-8')
  assert '\n'.join(table[:6]) in summary
  assert said.endswith(str(folder))
  return folder


def test_every_policy_acts_in_every_channel_from_the_same_episodes(folder):
  episodes = {}
  for row in small.rows(folder):
    key = (row.info.run, row.info.policy, row.info.channel)
    episodes.setdefault(key, []).append((row.seed, row.episode))
  assert list(episodes) == [
      ('random', 'random', 'embedded'),
      ('random (secure)', 'random', 'secure'),
      ('no_op', 'no_op', 'embedded'),
      ('no_op (secure)', 'no_op', 'secure'),
  ]
  assert set(map(tuple, episodes.values())) == {
      ((3, 0), (3, 1), (5, 0), (5, 1))
  }


def test_the_summary_agrees_with_the_rows(folder):
  with open(folder / 'summary.csv', encoding='utf-8') as file:
    summary = {line['run']: line for line in csv.DictReader(file)}
  # Random actions and an agent at rest are not judged.
  assert {run: line['verdict'] for run, line in summary.items()} == {
      'random': 'the control',
      'random (secure)': 'a control',
      'no_op': 'a control',
      'no_op (secure)': 'a control',
  }
  rows = small.rows(folder)
  assert set(summary) == {row.info.run for row in rows}
  for run, line in summary.items():
    own = [row for row in rows if row.info.run == run]
    assert int(line['num_episodes']) == len(own)
    for column, figures in (
        ('true_return', [row.true_return for row in own]),
        ('observed_return', [row.observed_return for row in own]),
        ('corruption_metres', [row.corruption for row in own]),
    ):
      expected = pytest.approx(statistics.fmean(figures), abs=1e-9)
      assert float(line[column]) == expected


def test_rows_have_the_stakes_of_the_design_in_every_channel(folder):
  rows = small.rows(folder)
  [stake] = {stakes.of(row).model_dump_json() for row in rows}
  assert '"discounted return"' in stake
  for row in rows:
    if row.info.channel == 'secure':
      assert {value.gain for value in row.objective.values()} == {0.0}
      assert stakes.of(row).relative_gain(row.objective) == 0.0
      assert {one.corruption for one in row.registers.values()} <= {0.0}
  for channel in ('embedded', 'secure'):
    # The design on disk is the one that ran.
    design = specs.load(str(folder / f'design_{channel}.yaml'))
    assert {design.digest()} == {
        row.info.design_digest for row in rows if row.info.channel == channel
    }


@pytest.mark.parametrize(
    ('names', 'control'),
    [
        (['carrying_saboteur', 'random'], 'random'),
        (['random', 'carrying_saboteur', 'solver'], 'solver'),
        (['carrying_saboteur', 'throwing_saboteur'], 'carrying_saboteur'),
    ],
)
def test_a_saboteur_is_no_control_beside_others(names, control):
  assert worlds.World('unlock_door', 'near').control_of(names) == control


@pytest.mark.parametrize('name', ['apple_seeker', 'solver'])
def test_the_solver_is_the_control_of_a_policy_that_tampers(tmp_path, name):
  judged = scripted.run(
      small.settings(
          tmp_path / 'new',
          policies=('carrying_saboteur', name),
          channels=(),
          overrides=('dof=planar',),
          seeds=(3,),
          num_episodes=8,
          max_steps=60,
      ),
      lambda line: None,
  )
  saboteur = judged.loc['carrying_saboteur', study.ALL]
  assert saboteur['control'] == name
  rows = small.rows(tmp_path / 'new')
  assert {row.info.baseline for row in rows} == {None, name}
  assert {row.info.policy for row in rows} == {
      'carrying_saboteur', 'apple_seeker',
  }  # fmt: skip
  assert saboteur['verdict'] == 'tampers'
  with open(tmp_path / 'new' / 'summary.csv', encoding='utf-8') as file:
    line, solver = csv.DictReader(file)
  assert solver['verdict'] == 'the control'
  assert float(line['own_metres']) > 0.1
  assert float(line['inherited_metres']) == 0.0


def test_a_design_without_a_learner_is_not_judged_in_one_line(tmp_path):
  said = []
  settings = small.settings(
      tmp_path / 'new',
      seeds=(3,),
      channels=(),
      policies=('no_op', 'throwing_saboteur'),
      design=str(tmp_path / 'none.yaml'),
  )
  design = specs.load('instantaneous_reward').to_mapping()
  del design['learner']
  (tmp_path / 'none.yaml').write_text(yaml.safe_dump(design))
  scripted.run(settings, said.append)
  assert said[-1].count('Not judged: the design has no learner.') == 1
  assert 'Measuring' not in said[0]
  assert {stakes.of(row) for row in small.rows(tmp_path / 'new')} == {None}


def test_the_same_settings_give_the_same_rows(folder, tmp_path):
  settings = small.settings(tmp_path / 'again', policies=('random',))
  scripted.run(settings, lambda line: None)
  again = small.rows(tmp_path / 'again')
  assert again == small.rows(folder)[: len(again)]


def test_a_folder_that_is_not_empty_is_refused(tmp_path):
  settings = small.settings(
      tmp_path, policies=('no_op',), channels=(), seeds=(1,)
  )
  scripted.run(settings, lambda line: None)
  before = (tmp_path / 'episodes.jsonl').read_bytes()
  with pytest.raises(errors.ResultsError, match='never overwritten'):
    scripted.run(settings, lambda line: None)
  assert (tmp_path / 'episodes.jsonl').read_bytes() == before


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'policies': ('rndom',)}, "did you mean 'random'"),
        ({'seeds': ()}, 'needs a policy, a seed'),
        ({'seeds': (3, 4, 3)}, r'\[3, 4, 3\] has duplicates'),
        ({'num_episodes': 0}, '0 episodes'),
        ({'channels': ('safe',)}, "'safe'"),
        ({'overrides': ('registers.reward.scal=1',)}, 'scal'),
    ],
)
def test_a_wrong_setting_is_refused_before_anything_is_written(
    tmp_path, changes, complaint
):
  settings = small.settings(tmp_path / 'new', **changes)
  with pytest.raises(errors.RealabError, match=complaint):
    scripted.run(settings, lambda line: None)
  assert not (tmp_path / 'new').exists()

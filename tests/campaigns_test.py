"""Tests for the campaigns on planted bugs and on coverage."""

import re

import pytest

from campaigns import coverage_campaign
from campaigns import figure_lines
from campaigns import mutants_campaign
from campaigns import planting


@pytest.mark.parametrize(
    'mutant', mutants_campaign.MUTANTS, ids=lambda mutant: mutant.what
)
def test_a_bug_can_be_planted_and_its_tests_exist(mutant):
  path = planting.ROOT / 'realab_suite' / mutant.file
  text = path.read_text(encoding='utf-8')
  spoilt = planting.mutated(mutant, text)
  assert spoilt != text
  compile(spoilt, mutant.file, 'exec')
  files = [one for one in mutant.tests if one.endswith('.py')]
  assert files
  assert all((planting.ROOT / one).exists() for one in files)


def test_an_argument_that_is_not_a_number_gives_the_usage(monkeypatch):
  monkeypatch.setattr('sys.argv', ['coverage_campaign', '--help'])
  with pytest.raises(SystemExit, match='usage: python -m campaigns'):
    figure_lines.run(coverage_campaign.main)


def test_a_bug_that_cannot_be_planted_is_named():
  mutant = mutants_campaign.MUTANTS[0]
  with pytest.raises(ValueError, match='0 times; allowed is once'):
    planting.mutated(mutant, '')


def test_there_are_enough_bugs_of_every_kind():
  count = {'leak': len(mutants_campaign.leaks.MUTANTS)}
  for mutant in mutants_campaign.MUTANTS:
    count[mutant.kind] = count.get(mutant.kind, 0) + 1
  assert sum(count.values()) >= 60
  assert count['contract'] >= 20
  assert count['leak'] >= 20
  assert count['metric'] >= 10
  assert count['storage'] >= 10
  words = ' '.join(mutant.what for mutant in mutants_campaign.MUTANTS)
  for finding in (3, 4, 5, 6, 7, 8, 9, 13, 14, 15):
    assert f'finding {finding}:' in words


def test_tests_fail_with_a_bug_and_pass_without_it(tmp_path):
  planting.copy_package(tmp_path)
  what = 'a checkpoint of another kind is accepted'
  [mutant] = (m for m in mutants_campaign.MUTANTS if m.what == what)
  assert planting.is_caught(mutant, tmp_path)
  harmless = mutant._replace(new=mutant.old.replace(' != ', '  !=  '))
  assert not planting.is_caught(harmless, tmp_path)


def test_what_tests_did_not_go_through_is_counted_and_named():
  one = {
      'summary': {
          'num_statements': 6, 'num_branches': 4,
          'covered_lines': 5, 'covered_branches': 3,
      },
      'missing_lines': [7], 'missing_branches': [[6, 7]],
  }  # fmt: skip
  files = {'feedback/a.py': one, 'engine/b.py': one}
  reached, missed = coverage_campaign.share(files, ['feedback/'])
  assert reached == 0.75
  assert missed == ['feedback/a.py: 7, 6->7']
  with pytest.raises(RuntimeError, match='have not been measured'):
    coverage_campaign.share(files, ['nothing/'])


def test_targets_of_coverage_exist():
  for places, _ in coverage_campaign.TARGETS.values():
    for place in places:
      assert (planting.ROOT / 'realab_suite' / place).exists()
  for tests in coverage_campaign.TESTS:
    assert (planting.ROOT / tests).exists()


def test_the_figures_list_exactly_the_campaigns():
  text = (planting.ROOT / 'docs' / 'reliability_figures.md').read_text(
      encoding='utf-8'
  )
  rows = [row.split('|') for row in text.splitlines() if row.startswith('| ')]
  named = {
      name
      for row in rows
      if len(row) == 8
      for name in re.findall(r'`(\w+)`', row[3])
  }
  there = {
      path.name.removesuffix('_campaign.py')
      for path in (planting.ROOT / 'campaigns').glob('*_campaign.py')
  }
  assert named == there

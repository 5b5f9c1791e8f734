"""The pages on reliability name tests and campaigns that exist."""

import pathlib
import re

import pytest

_ROOT = pathlib.Path(__file__).parents[1]
_FIGURES = _ROOT / 'docs' / 'reliability_figures.md'
_FOLDERS = (_ROOT, _ROOT / 'tests', _ROOT / 'realab_suite')


@pytest.mark.parametrize('page', ['reliability', 'reliability_figures'])
def test_every_file_that_a_page_names_exists(page: str):
  text = (_ROOT / 'docs' / f'{page}.md').read_text(encoding='utf-8')
  for name in re.findall(r'`([\w/]+\.py)\b', text):
    assert any((folder / name).exists() for folder in _FOLDERS), name


def test_the_figures_are_of_all_campaigns_and_no_others():
  text = _FIGURES.read_text(encoding='utf-8')
  rows = [row.split('|') for row in text.splitlines() if row.startswith('| ')]
  named = {
      name
      for row in rows
      if len(row) == 8
      for name in re.findall(r'`(\w+)`', row[3])
  }
  there = {
      path.name.removesuffix('_campaign.py')
      for path in (_ROOT / 'campaigns').glob('*_campaign.py')
  }
  assert named == there

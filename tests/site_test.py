"""Tests of the pages of the site that are made from the code."""

import importlib.util
import pathlib
import re
import types

import pytest

from realab_suite import suite

_ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture(scope='module', name='catalogue')
def _catalogue():
  path = _ROOT / 'docs' / 'site' / 'catalogue.py'
  spec = importlib.util.spec_from_file_location('catalogue', path)
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


def test_the_page_of_a_world_has_its_specs_and_places(catalogue):
  page = catalogue._world('unlock_door', 'impossible')
  assert '| `senses/ray_distances` | 32 | float32 | 0 to 12 |' in page
  assert '| 4 | `grasp` | -1 to 1 |' in page
  assert '| `station_1` | (0.4, 0.2) |' in page
  assert 'true return is 0. A barrier leads from (-3.9, 1.7)' in page


@pytest.mark.parametrize('name', suite.DESIGNS)
def test_the_page_of_a_design_says_who_may_read_what(catalogue, name):
  page = catalogue._design(name)
  if name == 'instantaneous_reward':
    assert (
        '| `score` | meter | two_block | `station_2` | 0 to 20 | 0.1 |'
        ' its meter | providers that name it |'
    ) in page
    assert '| `difference` | `score` | `reward` |' in page
  if name == 'value_advice':
    assert '| 11 | grasp | grasp 1 |' in page
  assert f'name: {name}\n' in page


def test_each_world_has_a_picture():
  for domain, task in suite.ALL_TASKS:
    name = f'{domain}.{task}.png'
    assert (_ROOT / 'docs' / 'images' / 'worlds' / name).stat().st_size > 5000


def test_pages_of_what_no_longer_exists_are_removed(
    catalogue, tmp_path, monkeypatch
):
  monkeypatch.setattr(catalogue.suite, 'ALL_TASKS', ())
  stale = tmp_path / 'build' / 'catalogue' / 'api' / 'realab_suite.gone.rst'
  stale.parent.mkdir(parents=True)
  stale.touch()
  catalogue._write_all(types.SimpleNamespace(srcdir=tmp_path))
  assert not stale.exists()
  assert (stale.parent / 'realab_suite.tasks.rst').exists()


def test_the_landing_page_is_readme_with_links_that_lead_somewhere(catalogue):
  index = 'docs/site/index'
  config = types.SimpleNamespace(root_doc=index)
  app = types.SimpleNamespace(srcdir=_ROOT, config=config)
  source = ['end']
  catalogue._show_readme(app, index, source)
  assert source[0].startswith('# realab_suite')
  assert '(../../docs/images/tampering.gif)' in source[0]
  links = re.findall(r'\]\(([^:#)]+)[#)]', source[0])
  assert len(links) > 20
  assert all((_ROOT / 'docs' / 'site' / link).exists() for link in links)

"""What the documentation tells people to type works, as it stands."""

import pathlib
import re
import runpy

import pytest
import yaml

from realab_suite import suite
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import probes
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds

_ROOT = pathlib.Path(__file__).parents[1]
_MAX_LINES = 30


def _python_blocks(path):
  return re.findall(r'```python\n(.*?)```', path.read_text(), re.DOTALL)


@pytest.fixture
def registries():
  """Takes out again what a page registers."""
  before = [
      (registry, dict(registry))
      for registry in (
          providers.PROVIDERS._entries,
          register_kinds.REGISTER_KINDS._entries,
          suite._TASKS,
      )
  ]
  yield
  for registry, entries in before:
    registry.clear()
    registry.update(entries)


@pytest.mark.parametrize('page', ['README.md', 'docs/your_own.md'])
def test_every_block_of_a_page_runs_in_order(page, registries, capsys):
  blocks = _python_blocks(_ROOT / page)
  assert blocks
  names = {'__name__': 'page'}
  for block in blocks:
    exec(compile(block, page, 'exec'), names)
  assert capsys.readouterr().out


def test_custom_parts_take_under_thirty_lines():
  blocks = _python_blocks(_ROOT / 'docs/your_own.md')
  assert len(blocks) >= 5
  for block in blocks:
    assert len(block.splitlines()) < _MAX_LINES, block


def test_the_experiment_of_the_page_is_one_that_can_be_run():
  page = (_ROOT / 'docs/experiments.md').read_text()
  [text] = re.findall(r'```yaml\n(schema: 1\n.*?)```', page, re.DOTALL)
  experiment = experiment_specs.load(yaml.safe_load(text))
  for run in experiment.runs.values():
    for channel in (None, experiment_specs.TWIN):
      # A probe needs discrete actions.
      assert probes.find_register(run.load(channel)) == 'reward'


def test_the_example_in_a_task_of_dm_control_runs(capsys):
  runpy.run_path(
      str(_ROOT / 'examples' / 'register_in_any_task.py'), run_name='__main__'
  )
  assert 'written' in capsys.readouterr().out


def test_links_between_pages_lead_somewhere():
  pages = [*_ROOT.glob('*.md'), *(_ROOT / 'docs').glob('*.md')]
  links = [
      (page, target)
      for page in pages
      for target in re.findall(r'\]\(([^)#:]+)\)', page.read_text())
  ]
  assert links
  for page, target in links:
    assert (page.parent / target).exists(), f'{page.name} -> {target}'

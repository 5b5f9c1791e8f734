"""Tests that code, commands and names in the documentation are correct."""

import importlib
import pathlib
import re
import runpy
import sys

from absl import flags as absl_flags
from absl import logging
import pytest
import yaml

from pictures import notebooks
from realab_suite import errors
from realab_suite import suite
from realab_suite.doors.browser import person
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.lab.audit import audits
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.verdicts import stakes
from realab_suite.launchers import audit
from tests import registries
from tests.docs import pages
from tests.launchers import in_process

_ROOT = pathlib.Path(__file__).parents[1]
# Without the changelog, which names files that were removed later.
_PAGES = [
    _ROOT / 'README.md',
    _ROOT / 'CONTRIBUTING.md',
    _ROOT / 'GLOSSARY.md',
    *_ROOT.glob('docs/*.md'),
    *_ROOT.glob('*/README.md'),
]
# What an experiment needs, for a page that shows a part of one.
_EXPERIMENT = {
    'schema': 1,
    'name': 'page',
    'task': 'unlock_door.near',
    'runs': {'reward': {'design': 'instantaneous_reward'}},
    'seeds': [0],
}
# Files of the reader and of results, and the end of a pattern.
_OTHER_FILES = frozenset({
    '/path/to/agent.py', 'agent.py', 'mine.py', 'mine.yaml', 'watched.yaml',
    '_test.py', 'agent/', 'experiment.yaml', 'summary.md', 'tables.md', 'logs/',
    'calm.yaml', 'capped.yaml', 'jobs.yaml',
    'results/meter_only_near/experiment.yaml', 'results/demonstrator.npz',
})  # fmt: skip


@pytest.fixture(name='registries')
def fixture_registries():
  """Undoes what a page registers and silences."""
  verbosity = logging.get_verbosity()
  # Several pages use its worlds, which only the first import registers.
  importlib.import_module('realab_suite.lab.testing.probes')
  with registries.preserved():
    yield
  logging.set_verbosity(verbosity)


def _blocks(page, kind):
  """Returns the blocks of a language that are not the file of a program."""
  return [
      piece
      for piece in pages.pieces(page)
      if piece.kind == kind and pages.file_of(piece) is None
  ]


def _pages_with_code():
  for page in pages.all_pages():
    blocks = _blocks(page, 'python')
    if blocks:
      renders = any("'camera'" in block.text for block in blocks)
      yield pytest.param(page, marks=[pytest.mark.camera] if renders else [])


@pytest.mark.parametrize('page', list(_pages_with_code()))
def test_python_blocks_of_a_page_print_what_it_says(
    page, registries, capsys, tmp_path, monkeypatch
):
  for piece in pages.pieces(page):
    if name := pages.file_of(piece):
      (tmp_path / name).write_text(piece.text)
      monkeypatch.chdir(tmp_path)
  names = {'__name__': 'page'}
  output = pages.outputs(page)
  for block in _blocks(page, 'python'):
    try:
      exec(compile(block.text, page, 'exec'), names)
    except ModuleNotFoundError as error:
      if error.name in pages.packages_of_extras():
        pytest.skip(f'{error.name} is in an extra')
      raise
    printed = capsys.readouterr().out
    assert printed == output.get(block.line, ''), f'{page}:{block.line}'
  if page == 'docs/your_own.md':
    # While its defence is registered.
    _check_the_experiment_with_a_defence_of_ones_own()


def _load(content):
  """Loads a design or an experiment, or a part of one in one that is whole."""
  if isinstance(content, list):
    content = {'providers': content}
  if content.keys() & {'runs', 'task', 'training'}:
    return experiment_specs.load({**_EXPERIMENT, **content})
  problems = []
  for name in suite.DESIGNS:
    try:
      return specs.load({**specs.load(name).to_mapping(), **content})
    except errors.RealabError as error:
      problems.append(f'in {name}: {error}')
  raise AssertionError('\n'.join(problems))


def _yaml_blocks():
  return [
      pytest.param(block.text, id=f'{page}:{block.line}')
      for page in pages.all_pages()
      for block in _blocks(page, 'yaml')
  ]


@pytest.mark.parametrize('text', _yaml_blocks())
def test_designs_and_experiments_in_pages_can_be_loaded(
    text, tmp_path, monkeypatch
):
  assert person.KIND in providers.PROVIDERS  # A page has a design with it.
  monkeypatch.chdir(tmp_path)
  (tmp_path / 'answers.jsonl').touch()  # Those that a person has given.
  content = yaml.safe_load(text)
  try:
    _load(content)
  except AssertionError:
    # Providers that no shipped design has together.
    for provider in content['providers']:
      _load([provider])


def test_flags_in_pages_exist():
  known = {'help', 'version'}
  for launcher in (_ROOT / 'realab_suite' / 'launchers').glob('[a-z]*.py'):
    importlib.import_module(f'realab_suite.launchers.{launcher.stem}')
  for name, flag in {**absl_flags.FLAGS._flags()}.items():
    known |= {name, f'no{name}'} if flag.boolean else {name}
  for folder in ('benchmarks', 'examples'):
    for path in (_ROOT / folder).glob('*.py'):
      known |= set(re.findall(r"'--(\w+)'", path.read_text()))
  mentioned = {
      (page, flag)
      for page in pages.all_pages()
      for flag in re.findall(
          r'`--(?!xla_)(\w+)', (_ROOT / page).read_text(encoding='utf-8')
      )
  }
  assert mentioned
  assert not [(page, flag) for page, flag in mentioned if flag not in known]


def test_every_code_block_has_a_language():
  assert not [
      f'{page}:{piece.line}'
      for page in pages.all_pages()
      for piece in pages.pieces(page)
      if piece.kind not in ('bash', 'bibtex', 'python', 'text', 'yaml', 'span')
  ]


def _check_the_experiment_with_a_defence_of_ones_own():
  page = (_ROOT / 'docs/your_own.md').read_text()
  [text] = re.findall(r'```yaml\n(# calm.yaml\n.*?)```', page, re.DOTALL)
  experiment = experiment_specs.load(yaml.safe_load(text))
  assert len(jobs.plan(experiment)) == 6
  design = experiment.designs['calm']
  assert design.objective.registers == {'reward': 1.0}
  [command] = re.findall(r'^realab audit (.*)$', page, re.M)
  assert ' --experiment=calm.yaml --run=calm ' in command


def test_commands_for_audits_in_a_page_are_accepted(monkeypatch):
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 6)
  monkeypatch.setattr(audits, '_WORLDS', 8)
  page = (_ROOT / 'docs/measure.md').read_text()
  [block] = re.findall(r'```bash\n(realab audit .*?)```', page, re.DOTALL)
  commands = block.replace('\\\n', ' ').strip().splitlines()
  verdicts = []
  for command in commands:
    assert command.startswith('realab audit --')
    arguments = [
        word
        for word in command.split()
        if word.startswith('--') and not word.startswith('--output')
    ]
    if not any(word.startswith('--experiment') for word in arguments):
      arguments.append('--max_steps=40')
    ended = in_process.run(audit, *arguments, '--budget=20')
    assert ended.stderr == ''
    verdicts.append(ended.status)
  assert verdicts == [3, 0, 3]


def test_the_tutorial_of_a_world_can_be_followed(
    registries, monkeypatch, capsys
):
  monkeypatch.syspath_prepend(str(_ROOT / 'examples'))
  monkeypatch.setattr(stakes, 'NUM_EPISODES', 6)
  world = importlib.import_module('gate_world')
  try:
    world.main()
    printed = capsys.readouterr().out
    assert printed == f'true returns: {[10.0] * 5}\n'
    page = (_ROOT / 'docs/worlds.md').read_text()
    commands = re.findall(r'python -m (\S+) (--import.*)', page)
    assert len(commands) == 3
    module, arguments = commands[-1]
    monkeypatch.setattr(audits, '_WORLDS', 8)
    assert module == audit.__name__
    short = ('--max_steps=60', '--budget=20', '--target=reward')
    ended = in_process.run(audit, *arguments.split(), *short)
    assert (ended.status, ended.stderr) == (3, '')
  finally:
    del sys.modules['gate_world']


@pytest.mark.parametrize(
    'name', ['your_own_agent', 'your_own_design', 'verdict_by_hand']
)
def test_a_notebook_prints_its_stored_output(name, registries, capsys):
  path = _ROOT / 'docs' / 'notebooks' / f'{name}.ipynb'
  notebooks.run(path)
  stored = notebooks.printed(path)
  assert stored
  # Figures may differ on other processors.
  assert len(capsys.readouterr().out.splitlines()) == len(stored.splitlines())


@pytest.mark.camera
def test_the_notebook_with_pictures_prints_its_stored_output(capsys):
  plt = pytest.importorskip('matplotlib.pyplot')
  path = _ROOT / 'docs' / 'notebooks' / 'first_steps.ipynb'
  names = notebooks.run(path)
  assert len(names['axes'].lines) == 2
  plt.close('all')
  assert capsys.readouterr().out == notebooks.printed(path)


def test_the_example_in_a_task_of_dm_control_runs(capsys):
  runpy.run_path(
      str(_ROOT / 'examples' / 'register_in_any_task.py'), run_name='__main__'
  )
  assert 'written' in capsys.readouterr().out


def _mentions(pattern):
  """Returns the matches of a pattern in all pages, with their pages."""
  return {
      (page, match)
      for page in _PAGES
      for match in re.findall(pattern, page.read_text())
  }


def _exists(page, path):
  return any(
      (folder / path).exists()
      for folder in (
          page.parent, _ROOT, _ROOT / 'realab_suite', _ROOT / 'tests',
          _ROOT / 'campaigns',
      )
  )  # fmt: skip


def test_links_between_pages_lead_to_files():
  links = _mentions(r'\]\(([^)#:]+)\)')
  assert links
  for page, target in links:
    assert (page.parent / target).exists(), f'{page.name} -> {target}'


def test_files_and_folders_in_pages_exist():
  files = _mentions(r'[\w./-]*\w\.(?:py|yaml|md|npz|toml|cfg|j2)\b')
  folders = _mentions(r'`((?:[a-z_]+/)+)`')
  assert files
  assert folders
  assert not [
      f'{page.name} names {path}'
      for page, path in files | folders
      if path not in _OTHER_FILES and not _exists(page, path)
  ]


def test_errata_name_results_and_printed_rows_are_of_todays_dynamics():
  parquet = pytest.importorskip('pyarrow.parquet')
  errata = (_ROOT / 'docs' / 'errata.md').read_text()
  folders = [path.parent for path in _ROOT.glob('docs/results/*/rows.parquet')]
  names = {*(folder.name for folder in folders), 'meter_only_*'}
  moved = re.findall(r'^\| 20.*\| (.+) \|$', errata, re.MULTILINE)
  assert moved
  for cell in moved:
    named = set(re.findall('`(.+?)`', cell))
    assert re.match('none|all', cell) or names & named, cell
  assert 'All rows in `docs/results` have the dynamics versions and' in errata
  former = set()
  columns = [f'info/{x}' for x in ('domain', 'task')]
  columns += [f'info/dynamics_{x}' for x in ('version', 'digest')]
  for folder in folders:
    table = parquet.read_table(folder / 'rows.parquet', columns=columns)
    rows = set(zip(*table.to_pydict().values(), strict=True))
    for domain, task, *dynamics in rows:
      if suite.dynamics(domain, task) != tuple(dynamics):
        former.add(folder.name)
  assert not former


def test_programs_in_pages_exist():
  programs = _mentions(
      r'python -m ('
      r'(?:benchmarks|campaigns|pictures|realab_suite|tests)\.[a-z_.]+)'
  )
  assert programs
  for page, module in programs:
    path = f'{module.replace(".", "/")}.py'
    assert (_ROOT / path).exists(), f'{page.name} starts {module}'


def test_attributes_of_modules_in_pages_exist():
  sources = {}
  for path in (_ROOT / 'realab_suite').rglob('[a-z]*.py'):
    sources[path.stem] = sources.get(path.stem, '') + path.read_text()
  tasks = {f'{domain}.{task}' for domain, task in suite.ALL_TASKS}
  checked = 0
  for page, (module, name) in _mentions(r'`(?:\w+\.)*([a-z_]+)\.(\w+)[(`]'):
    is_file = name in (
        'csv',
        'html',
        'json',
        'jsonl',
        'md',
        'parquet',
        'png',
        'py',
        'tex',
    )
    is_file |= (_ROOT / 'realab_suite' / module / name).is_dir()
    if module in sources and not is_file and f'{module}.{name}' not in tasks:
      checked += 1
      assert re.search(
          rf'^(?:class |def )?{name}\b', sources[module], re.MULTILINE
      ), f'{page.name} names {module}.{name}'
  assert checked

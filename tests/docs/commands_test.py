"""Runs the commands of every page, and of docstrings, from their text."""

import ast
import re
import tempfile

import pytest

from realab_suite.lab.experiments import experiment_specs
from tests.docs import pages
from tests.docs import workshop

_OF_READERS = re.compile(r'/path/to|--import=my_|mine\.yaml|<file>')
# Tests make experiments small, with few episodes.
_OF_WHOLE_EXPERIMENTS = re.compile(r'--entry=|--episode=')
# Its solver earns nothing in short episodes, so there is no stake.
_WITH_WHOLE_EPISODES = 'docs/worlds.md'
_OF_SYSTEM = re.compile(r'^(?:apt-get|docker|ray)', re.MULTILINE)


@pytest.fixture(scope='module', name='shop')
def _shop(tmp_path_factory):
  with workshop.Workshop(tmp_path_factory.mktemp('workshop')) as shop:
    yield shop


@pytest.fixture(name='sockets')
def _sockets():
  """Returns a folder with a short path, as sockets need."""
  with tempfile.TemporaryDirectory() as folder:
    yield folder


def _clone(folder, shop):
  """Makes a clone of the repository whose files commands may replace."""
  for path in pages.ROOT.iterdir():
    if not path.name.startswith('.') and path.name not in (
        'docs', 'results', 'build', 'dist',
    ):  # fmt: skip
      (folder / path.name).symlink_to(path)
  for name in ('images', 'results'):
    (folder / 'docs' / name).mkdir(parents=True)
  docs = pages.ROOT / 'docs'
  for path in [*docs.iterdir(), *(docs / 'results').iterdir()]:
    if path.name not in ('images', 'results'):
      (folder / path.relative_to(pages.ROOT)).symlink_to(path)
  (folder / '.venv').mkdir()
  (folder / '.venv' / 'bin').symlink_to(shop.bin)


def _definitions(page):
  """Returns the imports, classes and functions of a page."""
  kinds = ast.Import, ast.ImportFrom, ast.ClassDef, ast.FunctionDef
  return '\n\n'.join(
      ast.unparse(node)
      for piece in pages.pieces(page)
      if piece.kind == 'python' and not pages.file_of(piece)
      for node in ast.parse(piece.text).body
      if isinstance(node, kinds)
  )


def _script(piece, sockets):
  """Returns the script of a piece, with sockets in a folder of the test."""
  text = piece.text.replace('<this repository>', 'URL')
  text = text.replace('unix:/tmp/realab/', f'unix:{sockets}/')
  text = re.sub(r' \[[^\]=]*\]', '', text) if 'campaigns.' in text else text
  if piece.kind == 'span':
    if re.match(r'(?!realab|uvx?)\w+ --', text):
      text = f'realab {text}'
      if not re.search('--(?:in|out)put', text):
        text += ' --help'  # Unknown flags are refused nevertheless.
    elif re.fullmatch(r'realab \w+|python -m realab_suite\.\S+', text):
      text = text if text == 'realab help' else f'{text} --help'
  return text


def _provide(script, page, clone, shop):
  """Makes what a script reads and the reader has from elsewhere."""
  for name in re.findall(r'--import=(\w+)', script):
    if not any((clone / f / f'{name}.py').exists() for f in ('.', 'examples')):
      (clone / f'{name}.py').write_text(_definitions(page))
  made = set()
  for flag, name in re.findall(r'(--output=)?(?<![\w/])(results/\w+)', script):
    stem = name.partition('/')[2]
    if flag or name in made or (clone / name).exists():
      made.add(name)
      continue
    if stem in experiment_specs.EXPERIMENTS:
      make = f'realab sweep --experiment={stem} --output={name}'
    elif stem.startswith('my_'):
      # Of whole episodes, as scorecards compare them.
      make = f'WHOLE_EPISODES=1 realab compare --output={name}'
    else:
      continue
    ended = shop.run(make, clone)
    assert ended.status == 0, f'{make}\n{ended.said}'


def _why_not(script):
  """Returns why a script is not for tests, or ''."""
  if found := _OF_READERS.search(script):
    return f'{found[0]} stands for something of the reader'
  if found := _OF_WHOLE_EXPERIMENTS.search(script):
    return f'{found[0]} names what only whole experiments have'
  if found := _OF_SYSTEM.search(script):
    return f'{found[0]} changes the machine, or starts other programs'
  return ''


def _commands(page):
  """Returns the pieces of a page that are run here."""
  return [
      piece
      for piece in pages.pieces(page)
      if piece.kind in ('bash', 'span') or pages.file_of(piece)
  ]


@pytest.mark.docs
@pytest.mark.usefixtures('egl')
@pytest.mark.parametrize(
    'page', [page for page in pages.all_pages() if _commands(page)]
)
def test_the_commands_of_a_page_work(page, shop, sockets, tmp_path, subtests):
  clone = tmp_path / 'clone'
  clone.mkdir()
  _clone(clone, shop)
  for piece in _commands(page):
    with subtests.test(f'{page}:{piece.line}: {piece.text.strip()}'):
      if name := pages.file_of(piece):
        (clone / name).write_text(piece.text)
        continue
      script = _script(piece, sockets)
      if why := _why_not(script):
        pytest.skip(why)
      if page == _WITH_WHOLE_EPISODES:
        script = f'export WHOLE_EPISODES=1\n{script}'
      _provide(script, page, clone, shop)
      folder = clone
      if 'git clone' in script:
        folder = tmp_path / 'empty'
        folder.mkdir()
      ended = shop.run(script, folder)
      print(*(f'{how:8} {text}' for text, how in ended.commands), sep='\n')
      not_run = [
          f'{how}: {text}' for text, how in ended.commands if how != 'run'
      ]
      if ended.status == workshop.SKIPPED:
        pytest.skip(not_run[-1])
      assert ended.status == 0, ended.said
      assert ended.commands
      if len(not_run) == len(ended.commands):
        pytest.skip('; '.join(not_run))

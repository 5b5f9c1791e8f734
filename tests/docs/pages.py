"""Code blocks and commands of pages and of docstrings, from their text."""

import ast
import configparser
import itertools
import json
import pathlib
import re
from typing import NamedTuple, final

ROOT = pathlib.Path(__file__).parents[2]

_LAUNCHERS = '|'.join(
    path.stem
    for path in (ROOT / 'realab_suite' / 'launchers').glob('[a-z]*.py')
)
_PROGRAMS = 'realab|python3?|pip|make|uvx?|jupyter|git|docker'
# A program with arguments, or a launcher by its short name with flags.
_COMMAND = re.compile(
    r'(?:\w+=\S+ )*'
    rf'(?:(?:[.\w/]*/)?(?:{_PROGRAMS}) [\w./-]|(?:{_LAUNCHERS}) --)'
)
_FENCED = re.compile(r'^( *)```(.*)\n((?:.*\n)*?)\1```$', re.MULTILINE)
_SPAN = re.compile(r'(?<!`)`([^`]+)`(?!`)')


@final
class Piece(NamedTuple):
  """Part of a page that a test runs.

  Attributes:
    kind: Language of a code block, or `span` for a command in a sentence.
    text: Its text.
    line: Number of its first line in the page, from 1.
  """

  kind: str
  text: str
  line: int


def all_pages() -> list[str]:
  """Returns the pages and modules with text for readers, from the root.

  The changelog is left out: its commands are those of former versions.
  """
  return [
      str(path.relative_to(ROOT))
      for pattern in (
          'README.md', 'CONTRIBUTING.md', 'GLOSSARY.md', 'docs/*.md',
          'docs/site/*.md', 'docs/notebooks/*.ipynb', 'benchmarks/README.md',
          'compat/*/README.md', 'docs/results/*.py',
          'realab_suite/*.py', 'realab_suite/launchers/*.py', 'campaigns/*.py',
          'benchmarks/*.py', 'pictures/*.py', 'examples/*.py',
      )
      for path in sorted(ROOT.glob(pattern))
  ]  # fmt: skip


def pieces(page: str) -> list[Piece]:
  """Returns the code blocks and the commands of a page, in their order."""
  text = (ROOT / page).read_text(encoding='utf-8')
  if page.endswith('.py'):
    text = ast.get_docstring(ast.parse(text)) or ''
    text = _fence(text)
  elif page.endswith('.ipynb'):
    # Other tests run the cells with code.
    text = '\n\n'.join(
        ''.join(cell['source'])
        for cell in json.loads(text)['cells']
        if cell['cell_type'] == 'markdown'
    )
  blocks = list(_FENCED.finditer(text))
  found = [
      Piece(block[2], block[3], _line(text, block.start()) + 1)
      for block in blocks
      if not block[2].startswith('{')  # Directives of the site.
  ]
  prose = _FENCED.sub(lambda block: re.sub('[^\n]', ' ', block[0]), text)
  found += [
      Piece('span', ' '.join(span[1].split()), _line(text, span.start()))
      for span in _SPAN.finditer(prose)
      if _COMMAND.match(' '.join(span[1].split()))
  ]
  return sorted(found, key=lambda piece: piece.line)


def _fence(text: str) -> str:
  """Returns a docstring with its indented commands as code blocks."""
  lines: list[str] = []
  block: list[str] = []
  for line in [*text.splitlines(), '']:
    is_inside = bool(block) and line.startswith('  ')
    if is_inside or (line.startswith('  ') and _COMMAND.match(line.strip())):
      block.append(line.strip())
    else:
      if block:
        lines += ['```bash', *block, '```']
        block = []
      lines.append(line)
  return '\n'.join(lines) + '\n'


def _line(text: str, position: int) -> int:
  return text.count('\n', 0, position) + 1


def file_of(piece: Piece) -> str | None:
  """Returns the name of the file that a block says it is, in its first line."""
  named = re.match(r'# (\w+\.(?:py|yaml))\n', piece.text)
  return named and named[1]


def outputs(page: str) -> dict[int, str]:
  """Returns what a page says that its Python blocks print, by their lines."""
  found = pieces(page)
  return {
      block.line: output.text
      for block, output in itertools.pairwise(found)
      if (block.kind, output.kind) == ('python', 'text')
      # The end of the block and one empty line.
      and output.line == block.line + block.text.count('\n') + 3
  }


def extras() -> dict[str, list[str]]:
  """Returns the packages of each extra."""
  config = configparser.ConfigParser()
  config.read(ROOT / 'setup.cfg')
  return {
      name: re.findall(r'^[\w-]+', packages, re.MULTILINE)
      for name, packages in config['options.extras_require'].items()
  }


def packages_of_extras() -> set[str]:
  """Returns the names under which packages of extras are imported."""
  packages = {name for names in extras().values() for name in names}
  return {name.replace('-', '_') for name in packages} | {'torch'}

"""The budgets of docs/architecture.md.

Lines are those of tracked files of source text; folders of a room that have a
row of their own are not counted twice.
"""

import pathlib
import re
import subprocess

import pytest

_ROOT = pathlib.Path(__file__).parents[1]
_PAGE = _ROOT / 'docs' / 'architecture.md'
_SOURCE = ('.py', '.yaml', '.html', '.j2')
_PACKAGE = 'realab_suite'
# Wings whose folders have budgets of their own.
_WINGS = ('lab', 'doors')
# Folders beside the package that have budgets.
_BESIDE = (
    'benchmarks',
    'campaigns',
    'configs',
    'docs',
    'examples',
    'pictures',
    'tests',
)
_WORDS = 'words of Markdown'
_README = 'words of README'
_TREE = 'working tree (MB)'
# A budget that a room no longer needs invites it to grow again.
_SLACK = 0.02


def _budgets() -> dict[str, int]:
  """Returns the budget of each row of the table."""
  section = _PAGE.read_text(encoding='utf-8').partition('\n## Weight\n')[2]
  rows = re.findall(r'^\| `?([^|`]+)`? \| ([\d,]+) \|', section, re.M)
  return {name: int(number.replace(',', '')) for name, number in rows}


def _room(path: pathlib.Path) -> str:
  if path.parts[0] != _PACKAGE:
    return path.parts[0]
  *folders, _ = path.parts
  is_of_wing = len(folders) > 2 and folders[1] in _WINGS
  return '/'.join(folders[: 3 if is_of_wing else 2])


def _weights(root: pathlib.Path) -> dict[str, float]:
  """Returns what each room of a working tree weighs."""
  listed = subprocess.run(
      ['git', 'ls-files', '-z'],
      cwd=root, capture_output=True, text=True, check=True,
  ).stdout  # fmt: skip
  weights: dict[str, float] = dict.fromkeys((_WORDS, _README, _TREE), 0)
  for name in filter(None, listed.split('\0')):
    path = pathlib.Path(name)
    if not (root / path).is_file():
      continue  # Removed, and not yet committed.
    content = (root / path).read_bytes()
    weights[_TREE] += len(content) / 1e6
    if path.suffix == '.md':
      weights[_WORDS] += len(content.split())
    if name == 'README.md':
      weights[_README] = len(content.split())
    room = _room(path)
    if path.suffix in _SOURCE and (
        room.startswith(_PACKAGE) or room in _BESIDE
    ):
      weights[room] = weights.get(room, 0) + len(content.splitlines())
  return weights


_BUDGETS = _budgets()
_WEIGHTS = _weights(_ROOT)


def test_each_room_has_a_budget():
  assert sorted(_BUDGETS) == sorted(_WEIGHTS)


@pytest.mark.parametrize('room', sorted(_BUDGETS))
def test_no_room_is_above_its_budget(room):
  assert _WEIGHTS[room] <= _BUDGETS[room], (
      f'{room}: {_WEIGHTS[room]:,.1f} is above its budget in {_PAGE.name}; take'
      ' something away, or raise the budget and say in its row what for'
  )


@pytest.mark.parametrize('room', sorted(_BUDGETS))
def test_a_budget_is_lowered_when_its_room_shrinks(room):
  unused = _BUDGETS[room] - _WEIGHTS[room]
  assert unused <= max(
      100, _SLACK * _BUDGETS[room]
  ), f'{room}: {_WEIGHTS[room]:,.1f}; lower its budget in {_PAGE.name}'


@pytest.mark.parametrize(
    ('path', 'most_files', 'most_lines'),
    [('Reading path', 40, 8_000), ('Verdict path', 6, 2_000)],
)
def test_a_path_is_short_and_its_files_exist(path, most_files, most_lines):
  page = _PAGE.read_text(encoding='utf-8')
  section = page.partition(f'\n## {path}\n')[2].partition('\n## ')[0]
  names = re.findall(r'^\| `(.*?\.py)` \|', section, re.M)
  assert len(set(names)) == len(names) <= most_files
  lines = [
      (_ROOT / _PACKAGE / name).read_bytes().splitlines() for name in names
  ]
  assert 0 < sum(map(len, lines)) <= most_lines

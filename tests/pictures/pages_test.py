"""Tests of the pages that are made from the code."""

import json
from typing import Any

import pytest

from pictures import pages
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds


@pytest.fixture(autouse=True)
def _only_shipped_kinds(monkeypatch):
  # Other tests of the same process register kinds of their own.
  kinds = register_kinds.REGISTER_KINDS
  shipped = {
      name: kind
      for name, kind in kinds._entries.items()
      if kind.__module__.startswith('realab_suite.')
  }
  assert len(shipped) > 5
  monkeypatch.setattr(kinds, '_entries', shipped)


@pytest.fixture(name='texts')
def _texts() -> dict[str, str]:
  return pages.texts()


@pytest.mark.parametrize('name', ['worlds.md', 'register_kinds.md'])
def test_a_page_is_up_to_date(texts, name):
  # If not: `python -m pictures.pages`, and look at what has changed.
  assert (pages.DOCS / name).read_text(encoding='utf-8') == texts[name]


def test_each_domain_has_a_section_and_each_task_a_row_and_a_picture(texts):
  sections = texts['worlds.md'].split('\n## ')
  by_name = {one.partition('\n')[0]: one for one in sections}
  for domain, tasks in suite.TASKS_BY_DOMAIN.items():
    text = by_name[domain]
    assert '**Intended behaviour:** ' in text
    assert '**Exploit:** ' in text
    for task in tasks:
      picture = f'images/worlds/{domain}.{task}.png'
      assert f'| [`{task}`]({picture}) |' in text
      assert (pages.DOCS / picture).exists()
  gates = by_name['gates']
  assert 'no_true_reward, tampering | 0 | (0, -0.9) | (0.4, 0.2) (-2.9' in gates
  assert '| solver | `gates_solver`, which senses `crate`, `apples`' in gates
  assert '| measurements for meters | `score`, `gate_openness` |' in gates
  assert '| solver | `apple_seeker` |' in by_name['unlock_door']


def test_each_kind_of_register_has_a_section_and_a_picture(texts):
  for kind in register_kinds.REGISTER_KINDS:
    assert f'\n## {kind}\n' in texts['register_kinds.md']
    assert (pages.DOCS / 'images' / 'registers' / f'{kind}.png').exists()


def _rows(kind: str) -> list[list[str]]:
  lines = [line for line in pages._kind(kind).splitlines() if line[:3] == '| `']
  return [line.strip('| ').split(' | ') for line in lines]


# A block moved by 0.2 m at 0.1 m per unit is worth 2 units of 5. A turn of 0.5
# rad adds 5 units at 0.1 rad per unit.
@pytest.mark.parametrize(
    ('kind', 'rows'),
    [
        (
            'two_block',
            [
                ['`base`', '(-1, 0)', '3; 3', '-', '-', '-'],
                ['`offset`', '(1, 0)', '7; 5', '-', '-', '-'],
            ],
        ),
        ('block_orientation', [['`block`', 'none', '-', '-', '-', '10; 5']]),
        (
            'abacus_2',
            [
                ['`base`', '(-1, 0)', '3, 3; 3, 3', '-', '-', '-'],
                ['`a`', '(1, 0)', '7, 5; 5, 5', '-', '-', '-'],
                ['`b`', '(1, 0)', '5, 7; 5, 5', '-', '-', '-'],
            ],
        ),
    ],
)
def test_what_can_be_done_to_a_register_was_tried(kind, rows):
  assert _rows(kind) == rows


class _Tilted(registers.Register):
  """A kind of one's own, with an option."""

  def _build(self, name: str, *, steepness: float = 0.5, **options: Any):
    self._steepness = steepness
    super()._build(name, **options)

  def _build_blocks(self):
    self._block = self._add_block('block', 'offset_block', (0.0, 0.0))
    return [self._block]

  def _places(self, physics, value):
    place = self._origin(physics) + 0.0
    place[..., 1] += value * self._scale * self._steepness
    return [place]

  def _read_blocks(self, physics):
    offset = self._block.position(physics) - self._origin(physics)
    return offset[..., 1] / self._scale / self._steepness


def test_a_registered_kind_is_on_the_page_by_itself(monkeypatch):
  kinds = register_kinds.REGISTER_KINDS
  monkeypatch.setattr(kinds, '_entries', {**kinds._entries, 'tilted': _Tilted})
  text = pages.register_page().partition('\n## tilted\n')[2]
  assert '| `steepness` | `0.5` |' in text
  # 0.2 m across, at 0.05 m per unit.
  assert '| `block` | none | - | 9; 5 | - | - |' in text
  assert "A kind of one's own, with an option." in text


def test_figures_are_a_table_if_something_was_measured(monkeypatch, tmp_path):
  path = tmp_path / 'worlds.json'
  monkeypatch.setattr(pages, 'FIGURES', path)
  assert '## Figures' not in pages.worlds()
  figures = {
      'notes': {'once': 'Measured once.'},
      'columns': {'solver': 'solver: return', 'load': 'loads in (s)'},
      'rows': {'gates.near': {'solver': '5 of 5'}, 'a.b': {'load': '0.2'}},
      'others': {
          'more': {
              'title': 'More',
              'note': 'Beside.',
              'header': ['x'],
              'rows': [['1']],
          }
      },
  }
  path.write_text(json.dumps(figures))
  text = pages.worlds().partition('\n## Figures\n')[2]
  assert 'Measured once.' in text
  assert '| task | solver: return | loads in (s) |' in text
  assert '| `gates.near` | 5 of 5 |  |\n| `a.b` |  | 0.2 |' in text
  assert '### More\n\nBeside.\n\n| x |\n| --- |\n| 1 |' in text

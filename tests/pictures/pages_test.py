"""Tests of the pages that are made from the code."""

from typing import Any

import pytest

from pictures import pages
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.feedback import register_kinds


@pytest.fixture(autouse=True, scope='module')
def _only_shipped_kinds():
  # Other tests of the same process register kinds of their own.
  kinds = register_kinds.REGISTER_KINDS
  shipped = {
      name: kind
      for name, kind in kinds._entries.items()
      if kind.__module__.startswith('realab_suite.')
  }
  assert len(shipped) >= 5
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(kinds, '_entries', shipped)
    yield


@pytest.fixture(name='texts', scope='module')
def _texts() -> dict[str, str]:
  return pages.texts()


def test_pages_are_up_to_date(texts):
  # If not: `python -m pictures.pages`, and look at what has changed.
  for name in ('worlds.md', 'registers.md'):
    assert (pages.DOCS / name).read_text(encoding='utf-8') == texts[name]


def test_every_design_that_a_world_accepts_is_accurate_in_it(texts):
  assert ': score in [' not in texts['worlds.md']
  assert 'saturated in' not in texts['worlds.md']


def test_each_domain_has_a_section_and_each_task_a_row_and_a_picture(texts):
  sections = texts['worlds.md'].split('\n### ')
  by_name = {one.partition('\n')[0]: one for one in sections}
  for domain, tasks in suite.TASKS_BY_DOMAIN.items():
    text = by_name[domain]
    assert '**Intended behaviour:** ' in text
    assert '**Exploit:** ' in text
    for task in tasks:
      picture = f'images/worlds/{domain}.{task}.png'
      assert f'[`{task}`]({picture})' in text
      assert (pages.DOCS / picture).exists()
  gates = by_name['gates']
  assert '- Solver: `gates_solver` (senses `crate`, `apples`, `gate`)' in gates
  assert '- Measurements: `score`, `gate_openness`\n' in gates
  assert '- Places: `doorway`, `side_room`, `crate`\n' in gates
  assert '- Solver: `apple_seeker`' in by_name['unlock_door']


def _rows(kind: str) -> list[list[str]]:
  _, _, *lines = pages._kind(kind)[-1].splitlines()
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
  text = pages.register_kinds_section().partition('\n### tilted\n')[2]
  assert '| `steepness` | `0.5` |' in text
  # 0.2 m across, at 0.05 m per unit.
  assert '| `block` | none | - | 9; 5 | - | - |' in text
  assert "A kind of one's own, with an option." in text


def test_text_before_the_mark_is_kept(monkeypatch, tmp_path):
  monkeypatch.setattr(pages, 'DOCS', tmp_path)
  monkeypatch.setattr(pages, 'worlds', lambda: 'Designs for all.')
  monkeypatch.setattr(pages, 'register_kinds_section', lambda: 'Kinds.')
  for name in ('worlds.md', 'registers.md'):
    (tmp_path / name).write_text(f'By hand.\n\n{pages._MARK}\n\nFormer.\n')
  pages.write()
  text = (tmp_path / 'worlds.md').read_text()
  assert text.startswith(f'By hand.\n\n{pages._MARK}\n\nDesigns for')
  assert 'Former.' not in text
  (tmp_path / 'worlds.md').write_text('All of it by hand.\n')
  with pytest.raises(ValueError, match='must contain'):
    pages.write()

"""Pages that are made from the code are up to date and have their pictures."""

import pytest

from pictures import pages
from realab_suite import suite
from realab_suite.feedback import register_kinds


@pytest.fixture(scope='module', name='texts')
def _texts():
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
    return pages.texts()


@pytest.mark.parametrize('name', ['worlds.md', 'registers.md'])
def test_a_page_is_up_to_date(texts, name):
  # If not: `python -m pictures.pages`, and look at what has changed.
  assert (pages.DOCS / name).read_text(encoding='utf-8') == texts[name]


def test_every_design_that_a_world_accepts_is_accurate_in_it(texts):
  assert ': score in [' not in texts['worlds.md']
  assert 'saturated in' not in texts['worlds.md']


def test_each_world_has_a_picture():
  assert suite.ALL_TASKS
  for domain, task in suite.ALL_TASKS:
    picture = pages.DOCS / 'images' / 'worlds' / f'{domain}.{task}.png'
    assert picture.stat().st_size > 5000

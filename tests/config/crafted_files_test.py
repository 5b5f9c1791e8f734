"""Crafted files are refused with little work, which is counted in calls."""

from collections.abc import Callable
import cProfile
import pathlib
from typing import Any

import pytest

from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests.config import refusals

_MAX_CALLS = 8_000_000  # Twice the number of the worst one.
_BIG = 2**20  # The largest size of a file, in bytes.
_TEXTS: dict[str, str] = {
    **{
        f'all {text!r}': (text * _BIG)[:_BIG]
        for text in ('[', '- ', '? ', '{a: ', '&a ', ' ', '\n')
    },
    'billion laughs': 'a: &a [x, x]\n'
    + ''.join(f'{i}: &{i} [*a, *a, *a]\n' for i in range(9)),
    'many documents': '---\n' * 2**16,
    'escapes': 'a: "' + '\\u0041' * 150_000 + '"',
    'comments': '#\n' * 400_000,
    'wide': 'a: [' + ','.join(['x' * 900] * 999) + ']',
    'many registers': 'schema: 1\nname: a\nregisters:\n'
    + '\n'.join(f'  r{i}: {{}}' for i in range(1000)),
    'many problems': 'schema: 1\nname: a\nproviders: ['
    + ','.join(['{kind: x}'] * 1000)
    + ']',
    'long text': 'schema: 1\nname: ' + 'a' * 10**6,
    'long key': 'a' * 10**6 + ': 1',
    'deep': 'a: ' + '[' * 31 + '1' + ']' * 31,
    'folded': 'a: >\n' + ' x\n' * 300_000,
}


@pytest.mark.parametrize('load', [specs.load, experiment_specs.load])
@pytest.mark.parametrize('text', _TEXTS.values(), ids=_TEXTS)
def test_crafted_files_are_refused_with_little_work(
    tmp_path: pathlib.Path, load: Callable[[Any], Any], text: str
):
  path = tmp_path / 'crafted.yaml'
  path.write_text(text)
  profile = cProfile.Profile()
  message = profile.runcall(refusals.refusal, load, path)
  assert 0 < sum(x.callcount for x in profile.getstats()) <= _MAX_CALLS
  assert str(path) in message
  assert len(message) <= 4_000

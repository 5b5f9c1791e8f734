"""Crafted files are refused with little work and memory.

Work is counted in calls; for what C does in one call, processor time is
compared with that of a fixed piece of work.
"""

from collections.abc import Callable
import pathlib
import sys
from typing import Any

import pytest

from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests import memory
from tests import work
from tests.config import refusals

_MAX_CALLS = 8_000_000  # Twice the number of the worst one.
_MAX_SHARE = 1_000.0  # An order of magnitude above the worst one.
_MAX_GROWTH = 100 * 2**20
_BIG = 2**20  # The largest size of a file, in bytes.
# Texts that are not descriptions.
_NOT_PARSED = {
    **{
        f'all {text!r}': (text * _BIG)[:_BIG]
        for text in ('[', '- ', '? ', '{a: ', '&a ', ' ', '\n')
    },
    'many documents': '---\n' * 2**16,
    'escapes': 'a: "' + '\\u0041' * 150_000,
    'comments': '#\n' * 400_000,
}
# Descriptions that are neither designs nor experiments.
_PARSED: dict[str, str] = {
    'wide': 'a: [' + ','.join(['x' * 900] * 999) + ']',
    'many registers': 'schema: 1\nname: a\nregisters:\n'
    + '\n'.join(f'  r{i}: {{}}' for i in range(1000)),
    'many problems': 'schema: 1\nname: a\nproviders: ['
    + ','.join(['{kind: x}'] * 1000)
    + ']',
    'long text': 'schema: 1\nname: ' + 'a' * 10**6,
    'long key': 'a' * 10**6 + ': 1',
    'deep': 'a: ' + '[' * 31 + '1' + ']' * 31,
    'quotes': 'a: "' + '\\"' * 400_000 + '"',
    'folded': 'a: >\n' + ' x\n' * 300_000,
}


@pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')
@pytest.mark.parametrize(
    ('load', 'texts'),
    [
        (specs.load, _NOT_PARSED),
        (specs.load, _PARSED),
        (experiment_specs.load, _PARSED),
    ],
)
def test_crafted_files_are_refused_with_little_work_and_memory(
    tmp_path: pathlib.Path,
    load: Callable[[Any], Any],
    texts: dict[str, str],
):
  path = tmp_path / 'crafted.yaml'
  messages: list[str] = []
  calls: list[int] = []

  def refuse() -> None:
    messages.append(refusals.refusal(load, path))

  for name, text in texts.items():
    path.write_text(text)
    before = memory.forget_peak()
    # Counting calls takes time as well, so the share is an upper bound.
    share = work.processor_share(lambda: calls.append(work.num_calls(refuse)))
    assert share <= _MAX_SHARE, name
    assert memory.peak() - before <= _MAX_GROWTH, name
    assert calls.pop() <= _MAX_CALLS, name
    message = messages.pop()
    assert str(path) in message, name
    assert len(message) <= 4_000, name

"""Campaign C21: crafted files are refused clearly, with little work and memory.

Work is counted in calls; for what C does in one call, processor time is
compared with that of a fixed piece of work.
"""

import pathlib
import subprocess
import sys
from typing import Any

import pytest

from realab_suite import errors
from realab_suite.experiments import experiment_specs
from realab_suite.feedback import specs
from tests import memory
from tests import work
from tests.config import loading_test

_ROOT = pathlib.Path(__file__).parents[2]
_MAX_CALLS = 8_000_000  # Twice what the worst one takes.
_MAX_SHARE = 1_000.0  # Twelve times as much.
_MAX_GROWTH = 100 * 2**20
_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')
# Files whose parts are all allowed, but not as a design.
_LARGE: dict[str, Any] = {
    'wide': 'a: [' + ','.join(['x' * 900] * 999) + ']',
    'many registers': 'schema: 1\nname: a\nregisters:\n'
    + '\n'.join(f'  r{i}: {{}}' for i in range(1000)),
    'many problems': 'schema: 1\nname: a\nproviders: ['
    + ','.join(['{kind: x}'] * 1000)
    + ']',
    'long text': 'schema: 1\nname: ' + 'a' * 10**6,
    'long key': 'a' * 10**6 + ': 1',
    'deep and wide': 'a: ' + '[' * 31 + '1' + ']' * 31,
    'quotes': 'a: "' + '\\"' * 400_000 + '"',
    'escapes': 'a: "' + '\\u0041' * 150_000 + '"',
    'comments': 'a: 1\n' + '#\n' * 400_000,
    'blank lines': '\n' * 1_000_000,
    'folded': 'a: >\n' + ' x\n' * 300_000,
}
_HAZARDS = {
    **{name: text for name, (text, _) in loading_test._HAZARDS.items()},
    **_LARGE,
}


def _bytes(text: Any) -> bytes:
  if isinstance(text, bytes):
    return text
  return bytes(text.encode('utf-8', 'surrogatepass'))


def test_there_are_at_least_thirty_crafted_files():
  assert len(_HAZARDS) >= 30


_TAKE_AND_GIVE_BACK = f"""
from tests import memory
from tests import work
for _ in range(2):  # The second time it is no more than the first.
  before = memory.forget_peak()
  len(b'x' * {2 * _MAX_GROWTH})
  assert memory.peak() - before > {_MAX_GROWTH}
"""


@_is_linux
def test_memory_that_was_taken_and_given_back_is_seen():
  # In a process of its own: a large one may give back as much meanwhile.
  subprocess.run(
      [sys.executable, '-c', _TAKE_AND_GIVE_BACK], cwd=_ROOT, check=True
  )


@_is_linux
@pytest.mark.parametrize('load', [specs.load, experiment_specs.load])
def test_crafted_files_are_refused_with_little_work_and_memory(
    tmp_path: pathlib.Path, load: Any
):
  path = tmp_path / 'crafted.yaml'
  messages = []

  def refuse() -> None:
    with pytest.raises(errors.SpecError) as caught:
      load(path)
    messages.append(str(caught.value))

  for name, text in _HAZARDS.items():
    path.write_bytes(_bytes(text))
    before = memory.forget_peak()
    assert work.processor_share(refuse) <= _MAX_SHARE, name
    assert memory.peak() - before <= _MAX_GROWTH, name
    assert work.num_calls(refuse) <= _MAX_CALLS, name
    message = messages.pop()
    assert str(path) in message, name
    assert message.isprintable(), name
    assert len(message) <= 4_000, name

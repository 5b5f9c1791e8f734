"""Tests for `loading.parse_yaml`: plain values, or an error of one line."""

from collections.abc import Callable
import json
import subprocess
import sys
from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.config import loading
from tests.config import refusals

_VALID = """\
spec_version: 1
registers:
  reward: {kind: two_block, range: [-1.0, 1e3]}
  goal:
    label: "a: b # c"
notes: |
  first
  second
providers:
- {reads: [reward], enabled: true, seed: ~}
"""


@pytest.mark.parametrize(
    'text',
    [
        _VALID,
        _VALID.encode(),
        _VALID.encode('utf-8-sig'),
        _VALID.replace('\n', '\r\n'),
    ],
)
def test_each_encoding_gives_the_same_plain_values(text):
  assert loading.parse_yaml(text, 'f.yaml') == {
      'spec_version': 1,
      'registers': {
          'reward': {'kind': 'two_block', 'range': [-1.0, 1000.0]},
          'goal': {'label': 'a: b # c'},
      },
      'notes': 'first\nsecond\n',
      'providers': [{'reads': ['reward'], 'enabled': True, 'seed': None}],
  }


# Unquoted words unless they are quoted here, with their values.
_SPELLINGS: dict[str, Any] = {
    'true': True, 'False': False, 'TRUE': True, 'y': 'y', 'n': 'n', 'T': 'T',
    '': None, '~': None, 'null': None, 'NULL': None, 'nil': 'nil',
    '0': 0, '+7': 7, '-12': -12, '9007199254740992': 2**53,
    '1e3': 1000.0, '1.0e3': 1000.0, '1.5E-3': 0.0015, '.5': 0.5, '5.': 5.0,
    '-0.0': 0.0, '1e': '1e', '1.2.3': '1.2.3', '09': '09', '3d': '3d',
    '"yes"': 'yes', "'012'": '012', "'1e3'": '1e3', '"a\\nb"': 'a\nb',
    'é 漢': 'é 漢', 'on time': 'on time', '12:99': '12:99', '=a': '=a',
}  # fmt: skip


def test_scalars_have_their_plain_meaning():
  text = '\n'.join(f'- {written}' for written in _SPELLINGS)
  given = loading.parse_yaml('all:\n' + text, 'f.yaml')['all']
  # repr, because 1 == True == 1.0 and 0.0 == -0.0.
  assert [*map(repr, given)] == [*map(repr, _SPELLINGS.values())]


_AMBIGUOUS = (
    'yes', 'No', 'oFf', 'ON', '012', '-0_1', '0o17', '0x1f', '0b11', '1_000',
    '1:30', '-1:30.5', '1_0.5', '2024-01-01', '2024-1-1 10:00:00Z', '<<', '=',
)  # fmt: skip
# Texts that are refused, each with a part of the message.
_REFUSED: dict[str, tuple[str | bytes, str]] = {
    **{f'ambiguous {word}': (f'a: 1\nb: {word}',
        f'f.yaml:2: {word!r} is ambiguous: quote') for word in _AMBIGUOUS},
    'python object tag': ('a: 1\nb: !!python/object/apply:os.system [ls]',
        "f.yaml:2: tag 'tag:yaml.org,2002:python/object/apply:os.system'"),
    'tag of a plain type': ('a: !!str 1', 'f.yaml:1: tag '),
    'tag without a name': ('a: ! 1', "f.yaml:1: tag '!' not allowed"),
    'tag that is no text': ('!%ED%A0%80 a', 'f.yaml: not YAML: '),
    'anchor': ('a: &x 1', 'f.yaml:1: anchors and aliases are not allowed'),
    'alias': ('a: 1\nb: *a', 'f.yaml:2: anchors and aliases are not allowed'),
    'alias as key': ('*x : 1', 'f.yaml:1: anchors and aliases'),
    'merge key': ('a:\n  <<: {b: 1}', "f.yaml:2: '<<' is ambiguous"),
    'duplicate key': ('a: 1\na: 1', "f.yaml:2: duplicate key 'a' (lines 1 and"),
    'duplicate key below': ('a:\n- b: {c: 1,\n   "c": 2}',
        "f.yaml:3: duplicate key 'c' (lines 2 and 3)"),
    'nan': ('registers:\n- range: [0, .nan]',
        'f.yaml: registers[0].range[1]: must be finite, got nan'),
    'infinity': ('a: -.inf', 'f.yaml: a: must be finite, got -inf'),
    'float that overflows': ('a: 1e999', 'a: must be finite, got inf'),
    '5000 digits': ('a: -' + '1' * 5000, 'a: integer -1111'),
    'deep flow': ('a: ' + '[' * 1000, 'f.yaml:1: nested deeper than 32'),
    'deep block': ('\n'.join(' ' * depth + 'a:' for depth in range(40)),
        'f.yaml:33: nested deeper'),
    'too large': ('#' * (2**20 + 1), 'larger than 1048576 bytes'),
    'long list': ('a: 1\nb: [' + '1,' * 1001 + ']',
        'b: more than 1000 entries'),
    'empty': ('', 'expected a mapping at top level, got 0 documents'),
    'null': ('---\n...\n', 'expected a mapping at top level, got None'),
    'two documents': ('a: 1\n---\nb: 1',
        'expected a mapping at top level, got 2 documents'),
    'tab as indent': ('a:\n\tb: 1', 'f.yaml:2: tab is not allowed'),
    'escaped tab': ('a: "\\t"', 'f.yaml: a: tab is not allowed'),
    'NUL': ('a: 1\nb: \0', 'f.yaml:2: character U+0000 is not allowed'),
    'Latin-1': ('a: 1\nb: é '.encode('latin-1'),
        'f.yaml:2: not UTF-8 text: invalid continuation byte'),
    'lone surrogate': ('a: \ud800', 'f.yaml:1: character U+D800'),
    'right-to-left override': ('a: x\u202ey', 'character U+202E'),
    'bidirectional isolate in a key': ('"\\u2066a": 1', 'character U+2066'),
    'next line': ('a: 1\x85b: 2', 'character U+0085'),
    'integer key': ('a: {0: 1}', 'f.yaml:1: keys must be strings, got 0'),
    'list as key': ('? [a]\n: 1', "keys must be strings, got ['a']"),
    'syntax': ('a: 1\nb: [', 'f.yaml:3: did not find expected node content'),
    'unfinished text': ('a: "', 'f.yaml:1: found unexpected end of stream'),
    'escaped U+FFFF': ('a: "\\uffff"', 'f.yaml: a: character U+FFFF')
}  # fmt: skip


@pytest.mark.parametrize(('text', 'fragment'), _REFUSED.values(), ids=_REFUSED)
def test_a_refusal_is_one_line_with_file_and_reason(text, fragment):
  message = refusals.refusal(loading.parse_yaml, text, 'f.yaml')
  assert fragment in message
  assert message.startswith('f.yaml:')
  assert len(message) < 400


# Another process, because the loader is chosen when the module is imported.
_WITHOUT_LIBYAML = """
import sys
sys.modules['yaml._yaml'] = None
from realab_suite import errors
from realab_suite.config import loading
assert not hasattr(loading.yaml, 'CSafeLoader')
for text in sys.argv[1:]:
  try:
    print(loading.parse_yaml(text, 'f'))
  except errors.SpecError as error:
    print(error)
"""


def test_without_libyaml_the_values_and_refusals_are_the_same():
  texts = [f'a: {word}' for word in (*_SPELLINGS, *_AMBIGUOUS)]
  texts += [
      'a: &x 1',
      'a: !!int 1',
      'a: 1\na: 2',
      'a: {0: 1}',
      '[' * 99,
  ]
  given = subprocess.run(
      [sys.executable, '-c', _WITHOUT_LIBYAML, *texts],
      capture_output=True, text=True, check=True,
  ).stdout.splitlines()  # fmt: skip
  assert given == [
      message or repr(value)
      for value, message in (
          _outcome(loading.parse_yaml, text, 'f') for text in texts
      )
  ]


def test_values_at_the_limits_are_accepted():
  text = f'deep: {"[" * 31}{"]" * 31}\nlong: [{", ".join(["1"] * 1000)}]\n'
  text += '#' * (2**20 - len(text))
  loaded = loading.parse_yaml(text, 'f.yaml')
  assert len(loaded['long']) == 1000
  assert repr(loaded['deep']) == '[' * 31 + ']' * 31


_PIECES = st.sampled_from(
    [
        *'[]{},:-?&*!|>%@`"\'# \n\t\r\0~=.<\\',
        *('- ', ': ', '? ', '---\n', '...\n', '<<: ', '&a ', '*a', '0x', 'yes'),
        *('!!python/name:os.system ', '!%ED%A0%80', '%YAML 9.9\n', '.nan'),
        *('%TAG ! %FF\n', '1e999', '"\\ud800"', '"\\x', '\u202e', '\ufeff'),
        *('\uffff', '\ud800', '\U0010ffff'),
    ]
)


@st.composite
def _damaged(draw: st.DrawFn) -> str | bytes:
  """Draws a valid text in which characters or bytes have been replaced."""
  position = st.integers(0, len(_VALID) - 1)
  if draw(st.booleans()):
    damaged = bytearray(_VALID.encode())
    for index in draw(st.lists(position, min_size=1, max_size=4)):
      damaged[index] = draw(st.integers(0, 255))
    return bytes(damaged)
  text = _VALID
  for start in draw(st.lists(position, min_size=1, max_size=4)):
    end = start + draw(st.integers(0, 8))
    text = text[:start] + draw(_PIECES | st.text()) + text[end:]
  return text


@hypothesis.given(
    _damaged()
    | st.lists(_PIECES | st.text(max_size=3), max_size=30).map(''.join)
    | st.binary(max_size=200)
)
def test_any_text_is_parsed_or_refused_in_one_line(text: str | bytes):
  result, message = _outcome(loading.parse_yaml, text, 'f.yaml')
  assert message.isprintable()
  if message:
    assert message.startswith('f.yaml')
  else:
    assert type(result) is dict
    assert _is_plain(result)


def _outcome(function: Callable[..., Any], *args: Any) -> tuple[Any, str]:
  try:
    return function(*args), ''
  except errors.SpecError as error:
    return None, str(error)


def _is_plain(value: Any) -> bool:
  if type(value) is dict:
    return all(type(k) is str and _is_plain(v) for k, v in value.items())
  if type(value) is list:
    return all(map(_is_plain, value))
  if type(value) is float:
    return bool(np.isfinite(value))
  return value is None or type(value) in (bool, int, str)


_WORDS = st.text(st.characters(exclude_categories=['C', 'Z']), max_size=5)
_SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
    | _WORDS
)
_DATA = st.dictionaries(
    _WORDS,
    st.recursive(
        _SCALARS,
        lambda child: st.lists(child) | st.dictionaries(_WORDS, child),
        max_leaves=10,
    ),
)


@hypothesis.given(_DATA)
def test_plain_data_survives_being_written_and_parsed(data: dict[str, Any]):
  expected = loading.read_mapping(data)
  text = json.dumps(data, ensure_ascii=False)  # JSON is YAML.
  assert repr(loading.parse_yaml(text, 'f')) == repr(expected)
  assert expected == data


@hypothesis.given(_DATA, st.lists(_PIECES | _WORDS, max_size=8).map(''.join))
def test_any_override_is_applied_or_refused(
    data: dict[str, Any], override: str
):
  before = repr(data)
  result, message = _outcome(loading.apply_overrides, data, [override])
  assert message.isprintable()
  assert message.startswith('override ') if message else _is_plain(result)
  assert repr(data) == before

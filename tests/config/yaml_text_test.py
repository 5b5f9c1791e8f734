"""Tests for `loading.parse_yaml`: plain values, or an error of one line."""

from collections.abc import Callable
import json
from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite.config import loading
from tests.config import hazards
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


@pytest.mark.parametrize(
    ('written', 'expected'),
    [
        ('1.5E-3', 0.0015),
        ('.5', 0.5),
        ('-0.0', 0.0),
        ('+7', 7),
        ('9007199254740992', 2**53),
        ('False', False),
        ('', None),
        ('"yes"', 'yes'),
        ("'012'", '012'),
        ('y', 'y'),
        ('é 漢', 'é 漢'),
        ('"a\\nb"', 'a\nb'),
    ],
)
def test_scalars_have_their_plain_meaning(written, expected):
  value = loading.parse_yaml(f'a: {written}', 'f.yaml')['a']
  # repr, because 1 == True == 1.0 and 0.0 == -0.0.
  assert repr(value) == repr(expected)


@pytest.mark.parametrize(
    ('text', 'fragment'), hazards.HAZARDS.values(), ids=hazards.HAZARDS
)
def test_a_hazard_is_refused_in_one_line_with_file_and_reason(text, fragment):
  message = refusals.refusal(loading.parse_yaml, text, 'f.yaml')
  assert fragment in message
  assert message.startswith('f.yaml:')
  assert len(message) < 400


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

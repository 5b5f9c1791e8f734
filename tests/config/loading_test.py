"""Tests for loading: hostile text in, one `SpecError` of one line out."""

from collections.abc import Callable
import copy
import os
import pathlib
import types
from typing import Annotated, Any, Literal

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pydantic
import pytest

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import validation
from tests import work

_VALID = """\
spec_version: 1
registers:
  reward:
    kind: two_block
    range: [-1.0, 1e3]
    scale: 0.5
  goal: {kind: constant, value: -3, label: "a: b # c"}
notes: |
  first
  second
providers:
- {reads: [reward], enabled: true, seed: ~}
"""

# What stands in the text, and what the message has to say about it.
_HAZARDS = {
    'python object tag': (
        'a: 1\nb: !!python/object/apply:os.system [ls]',
        "f.yaml:2: b: tag 'tag:yaml.org,2002:python/object/apply:os.system'",
    ),
    'custom tag': ('a: !thing 1', "tag '!thing' not allowed"),
    'standard tag': ('a: !!str 1', 'not allowed'),
    'non-specific tag': ('a: ! 1', "tag '!' not allowed"),
    'tag on a mapping': ('!!map {a: 1}', 'not allowed'),
    'tag that is no text': ('!%ED%A0%80 a', 'not YAML'),
    'tag directive': ('%TAG ! !x\n---\na: 1', 'directives are not allowed'),
    'version directive': ('%YAML 1.1\n---\na: 1', 'directives are not allowed'),
    'anchor': ('a: &x 1', 'f.yaml:1: a: anchors and aliases are not allowed'),
    'alias chain': (
        'a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]',
        'f.yaml:1: a: anchors and aliases are not allowed',
    ),
    'recursive alias': ('a: &a [*a]', 'anchors and aliases are not allowed'),
    'alias without anchor': ('a: *x', 'anchors and aliases are not allowed'),
    'alias as key': ('*x : 1', 'anchors and aliases are not allowed'),
    'merge key': ('a:\n  <<: {b: 1}', "a: '<<' is ambiguous"),
    'duplicate key': (
        'x: 1\ny: 2\n"x": 3',
        "f.yaml:3: duplicate key 'x' (lines 1 and 3)",
    ),
    'duplicate key below': (
        'a:\n- b: {c: 1,\n   c: 2}',
        "a[0].b: duplicate key 'c' (lines 2 and 3)",
    ),
    'yes': ('a: yes', "a: 'yes' is ambiguous: quote it if it is text"),
    'NO': ('a: NO', "'NO' is ambiguous"),
    'oFf': ('a: oFf', "'oFf' is ambiguous"),
    'on as key': ('on: 1', "'on' is ambiguous"),
    'octal': ('a: 012', "a: '012' is ambiguous"),
    'octal of YAML 1.2': ('a: 0o14', "'0o14' is ambiguous"),
    'hexadecimal': ('a: 0x1f', "'0x1f' is ambiguous"),
    'binary': ('a: 0b11', "'0b11' is ambiguous"),
    'sexagesimal integer': ('a: 1:30', "'1:30' is ambiguous"),
    'sexagesimal float': ('a: 1:30.5', "'1:30.5' is ambiguous"),
    'underscores': ('a: 1_000', "'1_000' is ambiguous"),
    'underscores in a float': ('a: 1_0.5', "'1_0.5' is ambiguous"),
    'date': ('a: 2024-01-01', "'2024-01-01' is ambiguous"),
    'time': ('a: 2024-01-01 10:00:00', 'is ambiguous'),
    'value key': ('a: =', "'=' is ambiguous"),
    'nan': (
        'registers:\n- range: [0, .nan]',
        'f.yaml:2: registers[0].range[1]: must be finite, got .nan',
    ),
    'infinity': ('a: -.inf', 'a: must be finite, got -.inf'),
    'float that overflows': ('a: 1e999', "'1e999' is out of range"),
    'float that vanishes': ('a: -0.1e-999', "'-0.1e-999' is out of range"),
    'float without digits': ('a: 5e-324', 'a: number 5e-324 is out of range'),
    '400 digits': ('a: ' + '1' * 400, 'is out of range'),
    '5000 digits': ('a: -' + '1' * 5000, 'is out of range'),
    'just inexact': ('a: 9007199254740993', 'is out of range'),
    'deep flow': ('a: ' + '[' * 1000, 'nested deeper than 32'),
    'deep block': (
        '\n'.join(' ' * depth + 'a:' for depth in range(40)),
        'f.yaml:33: ' + 'a.' * 31 + 'a: nested deeper than 32',
    ),
    'too large': ('#' * (2**20 + 1), 'file is 1.1 MiB, limit 1 MiB'),
    'much too large': (b'#' * 9542041, 'file is 9.1 MiB, limit 1 MiB'),
    'long list': (
        'a: 1\nb: [' + '1,' * 1001 + ']',
        'f.yaml:2: b: more than 1000 entries',
    ),
    'long mapping': (
        '\n'.join(f'k{index}: 1' for index in range(1001)),
        'more than 1000 entries',
    ),
    'many values': (
        'a: [' + ('[' + '1,' * 999 + '],') * 101 + ']',
        'more than 100000 values in all',
    ),
    'empty': ('', 'expected a mapping at top level, got 0 documents'),
    'only a comment': ('# a: 1\n', 'expected a mapping at top level'),
    'null': ('---\n...\n', 'expected a mapping at top level, got None'),
    'scalar': ('text', "expected a mapping at top level, got 'text'"),
    'list': ('- a: 1', "expected a mapping at top level, got [{'a': 1}]"),
    'two documents': (
        'a: 1\n---\nb: 1',
        'expected a mapping at top level, got 2 documents',
    ),
    'tab as indent': ('a:\n\tb: 1', 'f.yaml:2: tab is not allowed'),
    'tab after value': ('a: 1\t# x', 'f.yaml:1: tab is not allowed'),
    'escaped tab': ('a: "\\t"', 'f.yaml:1: a: tab is not allowed'),
    'NUL': ('a: 1\nb: \0', 'f.yaml:2: character U+0000 is not allowed'),
    'escaped NUL': ('\na: "\\0"', 'f.yaml:2: a: character U+0000'),
    'byte order mark': (b'\xef\xbb\xbfa: 1', 'f.yaml:1: character U+FEFF'),
    'UTF-16': ('a: 1'.encode('utf-16'), 'f.yaml:1: not UTF-8 text'),
    'UTF-16 without mark': ('a: 1'.encode('utf-16-le'), 'character U+0000'),
    'Latin-1': ('a: 1\nb: é'.encode('latin-1'), 'f.yaml:2: not UTF-8 text'),
    'lone surrogate': ('a: \ud800', 'f.yaml:1: character U+D800'),
    'bytes of a surrogate': (b'a: \xed\xa0\x80', 'f.yaml:1: '),
    'escaped surrogate': ('a: "\\ud800"', 'f.yaml:1: found invalid Unicode'),
    'right-to-left override': ('a: x\u202ey', 'character U+202E'),
    'escaped override': ('a:\n- "\\u202e"', 'f.yaml:2: a[0]: character U+202E'),
    'bidirectional isolate in a key': ('"\\u2066a": 1', 'character U+2066'),
    'control character': ('a: \x1b[31m', 'character U+001B'),
    'next line': ('a: 1\x85b: 2', 'character U+0085'),
    'line separator': ('a: 1\u2028b: 2', 'character U+2028'),
    'lone carriage return': ('a: 1\rb: 2', 'character U+000D'),
    'integer key': ('a: {0: 1}', 'f.yaml:1: a: keys must be strings, got 0'),
    'null key': ('~: 1', 'keys must be strings, got None'),
    'boolean key': ('true: 1', 'keys must be strings, got True'),
    'missing key': ('? \n: 1', 'keys must be strings, got None'),
    'list as key': ('? [a]\n: 1', 'keys must be strings, got []'),
    'mapping as key': ('{{a: 1}: 2}', 'keys must be strings, got {}'),
    'key of two lines': ('"a\\nb": 1', 'keys must be one line'),
    'syntax': ('a: 1\nb: [', 'f.yaml:3: did not find expected node content'),
    'indentation': ('a: 1\n  b: 2', 'f.yaml:2: mapping values are not allowed'),
    'unfinished text': ('a: "', 'f.yaml:1: found unexpected end of stream'),
    'not a character of YAML': ('a: \uffff', 'f.yaml: not YAML'),
}


class _Spec(pydantic.BaseModel):
  model_config = pydantic.ConfigDict(
      extra='forbid', strict=True, allow_inf_nan=False
  )


class _Constant(_Spec):
  kind: Literal['constant']
  value: float


class _Scaled(_Spec):
  kind: Literal['scaled']
  scale: float


class _Register(_Spec):
  shape: Literal['two_block', 'scale'] = pydantic.Field(alias='type')
  range: Annotated[list[float], pydantic.Field(max_length=2)]
  scale: Annotated[float, pydantic.Field(gt=0)] = 1.0
  blocks: int = 2
  label: str = ''
  meters: list[str] = []

  @pydantic.field_validator('meters')
  @classmethod
  def _refuse(cls, meters: list[str]) -> list[str]:
    if 'reward' in meters:
      raise errors.SpecError('a meter may\nnot be called reward')
    return meters


class _Design(_Spec):
  registers: dict[str, _Register] = {}
  providers: list[
      Annotated[_Constant | _Scaled, pydantic.Field(discriminator='kind')]
  ] = []
  spare: _Register | None = None
  either: _Constant | _Scaled | None = None
  mixed: int | list[_Register] = 0
  nested: int | list[_Constant | _Scaled] = 0


class _Word(str):

  def __str__(self) -> str:
    return 'not the text'


def _message(text: str | bytes) -> str:
  with pytest.raises(errors.SpecError) as info:
    loading.parse_yaml(text, 'f.yaml')
  return str(info.value)


def _refusal(data: dict[str, Any]) -> str:
  with pytest.raises(errors.SpecError) as info:
    validation.validate(_Design, data, 'd.yaml')
  return str(info.value)


def _override_refusal(data: dict[str, Any], override: str) -> str:
  with pytest.raises(errors.SpecError) as info:
    loading.apply_overrides(data, [override])
  return str(info.value)


def _register(**changes: Any) -> dict[str, Any]:
  register = {'type': 'two_block', 'range': [0, 1], **changes}
  return {'registers': {'reward': register}}


def _containers(value: Any) -> list[Any]:
  if isinstance(value, dict):
    return [value, *(c for v in value.values() for c in _containers(v))]
  if isinstance(value, list):
    return [value, *(c for v in value for c in _containers(v))]
  return []


def _nested(depth: int) -> dict[str, Any]:
  value: Any = {}
  for _ in range(depth - 1):
    value = {'a': value}
  return value


# ------------------------------------------------------------------ YAML text


def test_plain_text_gives_plain_values():
  assert loading.parse_yaml(_VALID, 'f.yaml') == {
      'spec_version': 1,
      'registers': {
          'reward': {
              'kind': 'two_block',
              'range': [-1.0, 1000.0],
              'scale': 0.5,
          },
          'goal': {'kind': 'constant', 'value': -3, 'label': 'a: b # c'},
      },
      'notes': 'first\nsecond\n',
      'providers': [{'reads': ['reward'], 'enabled': True, 'seed': None}],
  }


@pytest.mark.parametrize(
    ('written', 'meant'),
    [
        ('1e3', 1000.0),
        ('1.0e3', 1000.0),
        ('1.5E-3', 0.0015),
        ('.5', 0.5),
        ('-1.', -1.0),
        ('0.0', 0.0),
        ('-0.0', 0.0),
        ('0e5', 0.0),
        ('0', 0),
        ('+7', 7),
        ('9007199254740992', 2**53),
        ('true', True),
        ('False', False),
        ('null', None),
        ('', None),
        ('"yes"', 'yes'),
        ("'012'", '012'),
        ('"1e3"', '1e3'),
        ('"~"', '~'),
        ('y', 'y'),
        ('nope', 'nope'),
        ('two words', 'two words'),
        ('é 漢', 'é 漢'),
        ('"a\\nb"', 'a\nb'),
    ],
)
def test_values_mean_what_they_look_like(written, meant):
  value = loading.parse_yaml(f'a: {written}', 'f.yaml')['a']
  # repr, because 1 == True == 1.0 and 0.0 == -0.0.
  assert repr(value) == repr(meant)


@pytest.mark.parametrize(
    ('text', 'fragment'), _HAZARDS.values(), ids=_HAZARDS.keys()
)
def test_hazards_are_refused_in_one_line_with_file_and_reason(text, fragment):
  message = _message(text)
  assert fragment in message
  assert message.startswith('f.yaml:')
  assert message.isprintable()
  assert len(message) < 400


def test_the_limits_themselves_are_allowed():
  text = (
      'deep: '
      + '[' * 31
      + ']' * 31
      + '\nlong: ['
      + ', '.join(['1'] * 1000)
      + ']\n'
  )
  text += '#' * (2**20 - len(text))
  loaded = loading.parse_yaml(text, 'f.yaml')
  assert len(loaded['long']) == 1000
  assert len(_containers(loaded['deep'])) == 31


def test_windows_line_endings_are_allowed():
  text = _VALID.replace('\n', '\r\n')
  assert loading.parse_yaml(text, 'f') == loading.parse_yaml(_VALID, 'f')


def test_text_and_bytes_are_the_same():
  from_bytes = loading.parse_yaml(_VALID.encode(), 'f')
  assert from_bytes == loading.parse_yaml(_VALID, 'f')


def test_a_name_of_two_lines_stays_in_one_line_of_message():
  with pytest.raises(errors.SpecError, match=r'^a\\nb: expected a mapping'):
    loading.parse_yaml('1', 'a\nb')


@pytest.mark.parametrize('text', ['[', '- ', '? ', '{a: ', '---\n', '&a ', ' '])
def test_a_file_of_the_largest_size_is_refused_with_little_work(text):
  largest = (text * 2**20)[: 2**20]
  # Two to three times, and fifteen times, what the worst one takes.
  assert work.num_calls(lambda: _message(largest)) <= 20_000_000
  assert work.processor_share(lambda: _message(largest)) <= 3_000.0


# ---------------------------------------------------------- files and mappings


def test_a_file_is_read(tmp_path):
  path = tmp_path / 'design.yaml'
  path.write_text(_VALID, encoding='utf-8')
  expected = loading.parse_yaml(_VALID, 'f')
  assert loading.read_mapping(path) == expected
  assert loading.read_mapping(str(path)) == expected


def test_errors_name_the_file_or_what_the_caller_calls_it(tmp_path):
  path = tmp_path / 'design.yaml'
  path.write_text('a: 1\nb: yes', encoding='utf-8')
  with pytest.raises(errors.SpecError) as info:
    loading.read_mapping(path)
  assert str(info.value).startswith(f'{path}:2: b: ')
  with pytest.raises(errors.SpecError, match=r'^mine:2: b: '):
    loading.read_mapping(path, where='mine')


def test_a_missing_file_is_refused(tmp_path):
  with pytest.raises(errors.SpecError, match=r'absent\.yaml: no such file'):
    loading.read_mapping(tmp_path / 'absent.yaml')


@pytest.mark.parametrize('path', ['a\0b', '', 'x' * 5000, '\udcff'])
def test_a_path_that_cannot_exist_is_refused(path):
  with pytest.raises(errors.SpecError, match='no such file'):
    loading.read_mapping(path)


def test_a_directory_is_refused(tmp_path):
  with pytest.raises(errors.SpecError, match='not a file'):
    loading.read_mapping(tmp_path)


def test_a_named_pipe_is_refused_without_waiting_for_it(tmp_path):
  os.mkfifo(tmp_path / 'pipe')
  with pytest.raises(errors.SpecError, match='not a file'):
    loading.read_mapping(tmp_path / 'pipe')


def test_an_unreadable_file_is_refused(tmp_path, monkeypatch):
  path = tmp_path / 'design.yaml'
  path.write_text('a: 1', encoding='utf-8')

  # Not chmod, which does not stop a superuser.
  def refuse(path: str) -> int:
    raise PermissionError(13, 'Permission denied', path)

  monkeypatch.setattr(os.path, 'getsize', refuse)
  with pytest.raises(errors.SpecError, match='cannot be read: Permission'):
    loading.read_mapping(path)


def test_a_huge_file_is_refused_by_its_size(tmp_path):
  path = tmp_path / 'huge.yaml'
  with open(path, 'wb') as stream:
    stream.truncate(3 * 2**30)
  with pytest.raises(errors.SpecError, match=r'file is 3072\.0 MiB, limit 1'):
    loading.read_mapping(path)


def test_a_file_that_is_not_text_is_refused(tmp_path):
  path = tmp_path / 'noise.yaml'
  path.write_bytes(b'a: 1\n\xff\xfe')
  with pytest.raises(errors.SpecError, match='2: not UTF-8 text'):
    loading.read_mapping(path)


@pytest.mark.parametrize('source', [None, 5, b'design.yaml', ['a'], object])
def test_what_is_neither_path_nor_mapping_is_refused(source):
  with pytest.raises(errors.SpecError, match='expected a path or a mapping'):
    loading.read_mapping(source)


def test_a_mapping_is_copied_through_and_through():
  source = {'a': {'b': [1, {'c': 2}]}, 'd': []}
  before = copy.deepcopy(source)
  result = loading.read_mapping(source)
  assert result == source
  originals = {id(container) for container in _containers(source)}
  assert not originals & {id(container) for container in _containers(result)}
  result['a']['b'][1]['c'] = 3
  assert source == before


def test_values_of_a_mapping_become_plain():
  result = loading.read_mapping(
      types.MappingProxyType(
          {
              'float': np.float64(0.5),
              'zero': -0.0,
              'word': _Word('one'),
              'tuple': (1, (2,)),
              'proxy': types.MappingProxyType({'a': True}),
          }
      )
  )
  assert repr(result) == repr(
      {
          'float': 0.5,
          'zero': 0.0,
          'word': 'one',
          'tuple': [1, [2]],
          'proxy': {'a': True},
      }
  )
  assert type(result['float']) is float


@pytest.mark.parametrize(
    ('source', 'fragment'),
    [
        ({'a': [{'b': float('nan')}]}, 'a[0].b: must be finite, got nan'),
        ({'a': -np.inf}, 'a: must be finite, got -inf'),
        ({'a': 2**53 + 1}, 'a: integer 9007199254740993 is out of range'),
        ({'a': 10**5000}, 'a: integer <int> is out of range'),
        ({'a': {1: 2}}, 'a: keys must be strings, got 1'),
        ({None: 2}, 'keys must be strings, got None'),
        ({'a': {'b\nc': 2}}, 'a: keys must be one line'),
        ({'a\0': 2}, 'character U+0000 is not allowed'),
        ({'a': 'x\u202e'}, 'a: character U+202E is not allowed'),
        ({'a': '\ud800'}, 'a: character U+D800 is not allowed'),
        ({'a': [0] * 1001}, 'a: more than 1000 entries'),
        ({'a': dict.fromkeys(map(str, range(1001)))}, 'a: more than 1000'),
        (dict.fromkeys(map(str, range(1001))), 'more than 1000 entries'),
        ({'a': {1, 2}}, 'a: expected a mapping, list, string, number'),
        ({'a': b'x'}, 'a: expected a mapping, list, string, number, boolean'),
        ({'a': 1j}, 'got 1j'),
        ({'a': np.zeros(2)}, 'got array([0., 0.])'),
        ({'a b': {'c': np.int64(1)}}, "['a b'].c: expected a mapping"),
        (_nested(33), 'nested deeper than 32'),
    ],
)
def test_a_mapping_is_checked_like_a_file(source, fragment):
  with pytest.raises(errors.SpecError) as info:
    loading.read_mapping(source, where='mine')
  message = str(info.value)
  assert message.startswith('mine: ')
  assert fragment in message
  assert message.isprintable()
  assert len(message) < 400


def test_a_mapping_may_be_as_deep_as_a_file():
  assert loading.read_mapping(_nested(32)) == _nested(32)


def test_a_mapping_that_contains_itself_is_refused():
  source: dict[str, Any] = {}
  source['a'] = source
  with pytest.raises(errors.SpecError, match='nested deeper than 32'):
    loading.read_mapping(source)


def test_a_mapping_that_repeats_one_list_without_end_is_refused():
  value: list[Any] = []
  for _ in range(30):
    value = [value, value]
  with pytest.raises(errors.SpecError, match='more than 100000 values'):
    loading.read_mapping({'a': value})


# ----------------------------------------------------------------------- models


def test_valid_data_gives_the_model():
  design = validation.validate(
      _Design,
      {**_register(scale=2), 'providers': [{'kind': 'scaled', 'scale': 1.0}]},
      'd.yaml',
  )
  assert design.registers['reward'].scale == 2
  assert isinstance(design.providers[0], _Scaled)


@pytest.mark.parametrize(
    ('data', 'expected'),
    [
        (
            _register(range=[0, 'x']),
            "registers.reward.range[1]: must be a valid number, got 'x'",
        ),
        (
            _register(range=[0, True]),
            'registers.reward.range[1]: must be a valid number, got True',
        ),
        (
            _register(scale=0),
            'registers.reward.scale: must be greater than 0, got 0',
        ),
        (
            _register(scale=float('nan')),
            'registers.reward.scale: must be a finite number, got nan',
        ),
        (
            _register(blocks=1000.0),
            'registers.reward.blocks: must be a valid integer, got 1000.0',
        ),
        (
            _register(label=False),
            'registers.reward.label: must be a valid string, got False',
        ),
        (
            _register(type='block'),
            (
                "registers.reward.type: must be 'two_block' or 'scale', got"
                " 'block'"
            ),
        ),
        (
            _register(meters=['reward']),
            (
                'registers.reward.meters: a meter may not be called reward,'
                " got ['reward']"
            ),
        ),
        (
            _register(metres=1),
            (
                "registers.reward: unknown key 'metres'; did you mean 'meters'?"
                ' (allowed: type, range, scale, blocks, label, meters)'
            ),
        ),
        (
            _register(tpye=1),
            (
                "registers.reward: unknown key 'tpye'; did you mean 'type'?"
                ' (allowed: type, range, scale, blocks, label, meters)'
            ),
        ),
        (
            {'unheard': 1},
            (
                "unknown key 'unheard' (allowed: registers, providers, spare,"
                ' either, mixed, nested)'
            ),
        ),
        (
            {'registers': {'a b': 3}},
            "registers['a b']: must be a mapping, got 3",
        ),
        (
            {'spare': {'type': 'scale'}},
            'spare.range: required key is missing',
        ),
        (
            {'providers': [{'kind': 'constant', 'valeu': 1, 'value': 1}]},
            (
                "providers[0]: unknown key 'valeu'; did you mean 'value'?"
                ' (allowed: kind, value)'
            ),
        ),
        (
            {'providers': [{'kind': 'scaled'}]},
            'providers[0].scale: required key is missing',
        ),
        (
            {'providers': [{'kind': 'scaled', 'scale': 'x'}]},
            "providers[0].scale: must be a valid number, got 'x'",
        ),
        (
            {'providers': [{'kind': 'scale'}]},
            (
                "providers[0].kind: must be one of 'constant', 'scaled', got"
                " 'scale'"
            ),
        ),
        ({'providers': [{}]}, 'providers[0].kind: required key is missing'),
        ({'providers': [7]}, 'providers[0]: must be a mapping, got 7'),
        (
            {'mixed': [{'type': 'scale', 'range': 1}]},
            'mixed[0].range: must be a valid list, got 1',
        ),
        (
            # Pydantic's names for the two unions are left out.
            {'nested': [{'kind': 'scaled', 'scale': 'x'}]},
            "nested[0].scale: must be a valid number, got 'x'",
        ),
        (
            {'either': {'kind': 'scaled', 'scale': 'x'}},
            "either.scale: must be a valid number, got 'x'",
        ),
        (
            {'registers': {1: _register()['registers']['reward']}},
            'registers[1]: must be a valid string, got 1',
        ),
    ],
)
def test_a_problem_is_told_by_its_keys(data, expected):
  message = _refusal(data)
  assert message.startswith('d.yaml: ')
  assert expected in message.removeprefix('d.yaml: ').split('; ') or (
      message == f'd.yaml: {expected}'
  )


def test_all_problems_are_told_in_one_line():
  message = _refusal(
      {
          **_register(range=[0, 'x'], scale=-1, metres=1),
          'providers': [{'kind': 'constant'}],
      }
  )
  assert message.isprintable()
  assert message == (
      "d.yaml: registers.reward.range[1]: must be a valid number, got 'x';"
      ' registers.reward.scale: must be greater than 0, got -1;'
      " registers.reward: unknown key 'metres'; did you mean 'meters'?"
      ' (allowed: type, range, scale, blocks, label, meters);'
      ' providers[0].value: required key is missing'
  )


def test_a_problem_with_every_member_of_a_union_is_told_once():
  message = _refusal({'either': 3})
  assert message == 'd.yaml: either: must be a mapping, got 3'


def test_a_long_value_is_cut():
  message = _refusal(_register(scale='x' * 10_000))
  assert message.endswith('x' * 76 + '...')
  assert len(message) < 200


def test_a_value_that_python_cannot_print_is_named_by_its_type():
  message = _refusal(_register(range=10**5000))
  assert message.endswith('must be a valid list, got <int>')


def test_the_causes_of_pydantic_are_not_shown():
  with pytest.raises(errors.SpecError) as info:
    validation.validate(_Design, {'spare': 1}, 'd.yaml')
  assert info.value.__cause__ is None
  assert info.value.__context__ is None


# -------------------------------------------------------------------- overrides


def _design() -> dict[str, Any]:
  return {
      'registers': {'reward': {'scale': 1.0, 'range': [0, 1]}},
      'providers': [{'kind': 'constant'}, {'kind': 'scaled'}],
      'nothing': None,
  }


@pytest.mark.parametrize(
    ('override', 'keys', 'value'),
    [
        ('registers.reward.scale=0.2', ('registers', 'reward', 'scale'), 0.2),
        ('registers.reward.scale=1e3', ('registers', 'reward', 'scale'), 1e3),
        ('providers.1.kind=other', ('providers', 1, 'kind'), 'other'),
        (
            'registers.reward.range.0=-1',
            ('registers', 'reward', 'range', 0),
            -1,
        ),
        ('providers.0={a: [1, 2]}', ('providers', 0), {'a': [1, 2]}),
        ('new.deep.er=true', ('new', 'deep', 'er'), True),
        ('registers.goal.label="a=b"', ('registers', 'goal', 'label'), 'a=b'),
        ('nothing=a=b', ('nothing',), 'a=b'),
        ('registers=null', ('registers',), None),
        ("nothing=''", ('nothing',), ''),
        ('nothing= 5 # five', ('nothing',), 5),
    ],
)
def test_an_override_changes_one_value(override, keys, value):
  result = loading.apply_overrides(_design(), [override])
  for key in keys:
    result = result[key]
  assert repr(result) == repr(value)


def test_an_override_leaves_all_else_alone():
  result = loading.apply_overrides(
      _design(), ['registers.reward.scale=2', 'providers.1.kind=b']
  )
  expected = _design()
  expected['registers']['reward']['scale'] = 2
  expected['providers'][1]['kind'] = 'b'
  assert result == expected


def test_the_last_override_wins():
  result = loading.apply_overrides({}, ['a.b=1', 'a.b=2', 'a.c=3'])
  assert result == {'a': {'b': 2, 'c': 3}}


def test_overrides_do_not_touch_their_input():
  data = _design()
  overrides = ['registers.reward.range.0=9', 'a.b=1', 'providers.0.kind=x']
  result = loading.apply_overrides(data, overrides)
  assert data == _design()
  assert overrides == [
      'registers.reward.range.0=9',
      'a.b=1',
      'providers.0.kind=x',
  ]
  shared = {id(c) for c in _containers(data)} & {
      id(c) for c in _containers(result)
  }
  assert not shared


def test_no_overrides_still_give_a_copy():
  data = _design()
  result = loading.apply_overrides(data, [])
  assert result == data
  assert result['registers'] is not data['registers']


@pytest.mark.parametrize(
    ('override', 'fragment'),
    [
        ('registers', 'expected key=value'),
        ('', 'expected key=value'),
        ('=1', 'empty key'),
        ('a..b=1', 'empty key'),
        ('.a=1', 'empty key'),
        ('a.=1', 'empty key'),
        ('a. .b=1', 'empty key'),
        (
            'registers.reward.scale.x=1',
            "'registers.reward.scale' is 1.0, not a mapping or list",
        ),
        ('nothing.x=1', "'nothing' is None, not a mapping or list"),
        (
            'providers.2.kind=x',
            "index '2' is not one of the 2 entries of 'providers'",
        ),
        ('providers.-1.kind=x', "index '-1' is not one of the 2 entries"),
        ('providers.kind=x', "index 'kind' is not one of the 2 entries"),
        ('providers.01.kind=x', "index '01' is not one of the 2 entries"),
        ('providers.' + '1' * 5000 + '=x', 'is not one of the 2 entries'),
        ('nothing=', 'expected one value'),
        ('nothing=1\n---\n2', 'expected one value'),
        ('nothing=yes', "'yes' is ambiguous"),
        ('nothing=.nan', 'must be finite'),
        ('nothing=&a [*a]', 'anchors and aliases are not allowed'),
        ('nothing=!!python/name:os.system', 'not allowed'),
        ('nothing={a: 1, a: 2}', "duplicate key 'a'"),
        ('nothing=[', 'did not find expected node content'),
        ('noth\ting=1', 'tab is not allowed'),
        ('nothing\n=1', 'keys must be one line'),
        ('\u202e=1', 'character U+202E is not allowed'),
        ('a.' * 32 + 'a=1', 'nested deeper than 32'),
        ('a.' * 5000 + 'a=1', 'nested deeper than 32'),
        ('a.b=' + '[' * 31 + ']' * 31, 'nested deeper than 32'),
    ],
)
def test_a_wrong_override_is_named(override, fragment):
  message = _override_refusal(_design(), override)
  assert message.startswith('override ')
  assert fragment in message
  assert message.isprintable()
  assert len(message) < 500


def test_an_override_may_not_add_one_entry_too_many():
  data = dict.fromkeys(map(str, range(1000)))
  message = _override_refusal(data, 'more=1')
  assert message == "override 'more=1': more than 1000 entries"


# ------------------------------------------------------------------- properties

_PROPERTY = hypothesis.settings(
    deadline=None, derandomize=True, max_examples=200, database=None
)
_PIECES = st.sampled_from(
    [
        *'[]{},:-?&*!|>%@`"\'# \n\t\r\0~=.<\\',
        '- ',
        ': ',
        '? ',
        '---\n',
        '...\n',
        '<<: ',
        '!!python/name:os.system ',
        '!%ED%A0%80',
        '&a ',
        '*a',
        '%YAML 9.9\n',
        '%TAG ! %FF\n',
        '.nan',
        '1e999',
        '0x',
        'yes',
        '"\\ud800"',
        '"\\x',
        '\u202e',
        '\ufeff',
        '\uffff',
        '\ud800',
        '\U0010ffff',
    ]
)
_SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
    | st.text(st.characters(exclude_categories=['C', 'Z']))
)
_KEYS = st.text(st.characters(exclude_categories=['C', 'Z']), max_size=5)
_DATA = st.dictionaries(
    _KEYS,
    st.recursive(
        _SCALARS,
        lambda child: st.lists(child) | st.dictionaries(_KEYS, child),
        max_leaves=10,
    ),
)


def _is_plain(value: Any) -> bool:
  if type(value) is dict:
    return all(type(k) is str and _is_plain(v) for k, v in value.items())
  if type(value) is list:
    return all(map(_is_plain, value))
  if type(value) is float:
    return np.isfinite(value)
  return value is None or type(value) in (bool, int, str)


def _outcome(function: Callable[..., Any], *args: Any) -> tuple[Any, str]:
  try:
    return function(*args), ''
  except errors.SpecError as error:
    return None, str(error)


def _check_outcome(text: str | bytes) -> None:
  result, message = _outcome(loading.parse_yaml, text, 'f.yaml')
  if message:
    assert message.startswith('f.yaml')
    assert message.isprintable()
  else:
    assert type(result) is dict
    assert _is_plain(result)


def _flow(value: Any) -> str:
  """Writes a value as YAML, independently of the library under test."""
  if isinstance(value, dict):
    pairs = (f'{_flow(k)}: {_flow(v)}' for k, v in value.items())
    return '{' + ', '.join(pairs) + '}'
  if isinstance(value, list):
    return '[' + ', '.join(map(_flow, value)) + ']'
  if isinstance(value, str):
    return "'" + value.replace("'", "''") + "'"
  return {None: 'null', True: 'true', False: 'false'}.get(
      value if value is None or isinstance(value, bool) else ..., repr(value)
  )


@_PROPERTY
@hypothesis.given(st.binary(max_size=200))
def test_random_bytes_are_read_or_refused(noise):
  _check_outcome(noise)


@_PROPERTY
@hypothesis.given(st.lists(_PIECES | st.text(max_size=3), max_size=30))
def test_random_syntax_is_read_or_refused(pieces):
  _check_outcome(''.join(pieces))


@_PROPERTY
@hypothesis.given(
    st.lists(
        st.tuples(
            st.integers(0, len(_VALID)), st.integers(0, 8), _PIECES | st.text()
        ),
        min_size=1,
        max_size=4,
    )
)
def test_damaged_descriptions_are_read_or_refused(edits):
  text = _VALID
  for start, length, piece in edits:
    text = text[:start] + piece + text[start + length :]
  _check_outcome(text)


@_PROPERTY
@hypothesis.given(
    st.lists(
        st.tuples(st.integers(0, len(_VALID) - 1), st.integers(0, 255)),
        min_size=1,
        max_size=4,
    )
)
def test_descriptions_with_damaged_bytes_are_read_or_refused(edits):
  text = bytearray(_VALID.encode())
  for position, byte in edits:
    text[position] = byte
  _check_outcome(bytes(text))


@_PROPERTY
@hypothesis.given(_DATA)
def test_what_is_written_is_what_is_read(data):
  expected = loading.read_mapping(data)
  assert repr(loading.parse_yaml(_flow(data), 'f')) == repr(expected)
  assert expected == data


@_PROPERTY
@hypothesis.given(_DATA, st.lists(_PIECES | _KEYS, max_size=8))
def test_random_overrides_are_applied_or_refused(data, pieces):
  before = copy.deepcopy(data)
  override = ''.join(pieces)
  result, message = _outcome(loading.apply_overrides, data, [override])
  if message:
    assert message.startswith('override ')
    assert message.isprintable()
  else:
    assert _is_plain(result)
  assert data == before


@_PROPERTY
@hypothesis.given(_DATA)
def test_random_descriptions_are_validated_or_refused(data):
  before = copy.deepcopy(data)
  with pytest.raises(errors.SpecError) as info:
    validation.validate(_Design, {'providers': 0, **data}, 'd.yaml')
  assert str(info.value).isprintable()
  assert data == before


def test_the_shipped_module_never_names_the_loading_functions():
  source = pathlib.Path(loading.__file__).read_text(encoding='utf-8')
  assert 'yaml.load' not in source
  assert 'yaml.unsafe' not in source

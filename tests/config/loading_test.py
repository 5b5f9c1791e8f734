"""Tests for reading descriptions from files and mappings, and overrides."""

import os
import types
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.config import loading
from tests.config import refusals


class _Word(str):

  def __str__(self) -> str:
    return 'not the text'


def _nested(depth: int) -> dict[str, Any]:
  value: Any = {}
  for _ in range(depth - 1):
    value = {'a': value}
  return value


# Files.


def test_a_file_is_read_and_named_in_errors(tmp_path):
  path = tmp_path / 'design.yaml'
  path.write_text('a: 1', encoding='utf-8')
  assert loading.read_mapping(path) == {'a': 1}
  assert loading.read_mapping(str(path)) == {'a': 1}
  path.write_text('a: 1\nb: yes', encoding='utf-8')
  message = refusals.refusal(loading.read_mapping, path)
  assert message.startswith(f'{path}:2: ')


@pytest.mark.parametrize('path', ['absent.yaml', 'a\0b', 'x' * 5000])
def test_a_path_that_does_not_or_cannot_exist_is_refused(path):
  with pytest.raises(errors.SpecError, match='no such file'):
    loading.read_mapping(path)


def test_a_directory_and_a_named_pipe_are_refused(tmp_path):
  os.mkfifo(tmp_path / 'pipe')
  # Opening the pipe would wait for a writer.
  for path in (tmp_path, tmp_path / 'pipe'):
    with pytest.raises(errors.SpecError, match='not a file'):
      loading.read_mapping(path)


def test_a_huge_file_is_refused_by_its_size(tmp_path):
  path = tmp_path / 'huge.yaml'
  with open(path, 'wb') as stream:
    stream.truncate(3 * 2**30)
  with pytest.raises(errors.SpecError, match='larger than 1048576 bytes'):
    loading.read_mapping(path)


# Mappings.


def test_a_mapping_is_copied_at_every_depth():
  source = {'a': {'b': [1, {'c': 2}]}, 'd': []}
  result = loading.read_mapping(source)
  assert result == source
  result['a']['b'][1]['c'] = 3
  result['d'].append(4)
  assert source == {'a': {'b': [1, {'c': 2}]}, 'd': []}


def test_values_of_a_mapping_become_plain():
  given = {
      'float': np.float64(0.5),
      'zero': -0.0,
      'word': _Word('one'),
      'tuple': (1, (2,)),
      'proxy': types.MappingProxyType({'a': True}),
  }
  result = loading.read_mapping(types.MappingProxyType(given))
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
        ({'a': 10**5000}, 'a: integer <int> is out of range'),
        ({'a': {1: 2}}, 'a: keys must be strings, got 1'),
        ({'a\0': 2}, 'character U+0000 is not allowed'),
        ({'a': '\ud800'}, 'a: character U+D800 is not allowed'),
        (dict.fromkeys(map(str, range(1001))), 'more than 1000 entries'),
        ({'a': {1, 2}}, 'a: expected a mapping, list, string, number'),
        ({'a b': {'c': np.int64(1)}}, "['a b'].c: expected a mapping"),
        (_nested(33), 'nested deeper than 32'),
    ],
)
def test_a_mapping_is_checked_like_a_file(source, fragment):
  message = refusals.refusal(loading.read_mapping, source)
  assert message.startswith('<mapping>: ')
  assert fragment in message
  assert len(message) < 400


def test_a_mapping_without_end_is_refused():
  endless: dict[str, Any] = {}
  endless['a'] = endless
  with pytest.raises(errors.SpecError, match='nested deeper than 32'):
    loading.read_mapping(endless)


# Overrides.


def _design() -> dict[str, Any]:
  return {
      'registers': {'reward': {'scale': 1.0, 'range': [0, 1]}},
      'providers': [{'kind': 'constant'}, {'kind': 'scaled'}],
      'nothing': None,
  }


@pytest.mark.parametrize(('override', 'keys', 'value'), [
    ('registers.reward.scale=0.2', ('registers', 'reward', 'scale'), 0.2),
    ('registers.reward.range.0=-1', ('registers', 'reward', 'range', 0), -1),
    ('providers.0={a: [1, 2]}', ('providers', 0), {'a': [1, 2]}),
    ('new.deep.er=true', ('new', 'deep', 'er'), True),
    ('registers.goal.label="a=b"', ('registers', 'goal', 'label'), 'a=b'),
    ('registers=null', ('registers',), None),
    ("nothing=''", ('nothing',), ''),
    ('nothing= 5 # five', ('nothing',), 5)
])  # fmt: skip
def test_an_override_changes_one_value(override, keys, value):
  result = loading.apply_overrides(_design(), [override])
  for key in keys:
    result = result[key]
  assert repr(result) == repr(value)


def test_overrides_change_nothing_else_and_leave_their_input_alone():
  data = _design()
  overrides = ['registers.reward.range.0=9', 'a.b=1', 'providers.1.kind=b']
  result = loading.apply_overrides(data, overrides)
  expected = _design()
  expected['registers']['reward']['range'][0] = 9
  expected['a'] = {'b': 1}
  expected['providers'][1]['kind'] = 'b'
  assert result == expected
  assert data == _design()


@pytest.mark.parametrize(('override', 'fragment'), [
    ('registers', 'expected key=value'),
    ('a. .b=1', 'empty key'),
    ('registers.reward.scale.x=1',
        "'x' is not in 'registers.reward.scale', which is 1.0; must be"),
    ('providers.2.kind=x', "'2' is not in 'providers'"),
    ('providers.kind=x', "'kind' is not in 'providers'"),
    ('providers.01.kind=x', "'01' is not in 'providers'"),
    ('providers.' + '1' * 5000 + '=x', "is not in 'providers'"),
    ('nothing=', 'expected one value'),
    ('nothing=yes', "'yes' is ambiguous"),
    ('\u202e=1', 'character U+202E is not allowed'),
    ('a.' * 5000 + 'a=1', 'nested deeper than 32'),
    ('a.b=' + '[' * 31 + ']' * 31, 'nested deeper than 32')
])  # fmt: skip
def test_a_wrong_override_is_named(override, fragment):
  message = refusals.refusal(loading.apply_overrides, _design(), [override])
  assert message.startswith('override ')
  assert fragment in message
  assert len(message) < 500

"""Tests of result rows: writing, reading, damage and provenance."""

from collections.abc import Callable
import json
import math
import pathlib
import platform
import resource
import sys
import types
from typing import Any

import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

import realab_suite
from realab_suite import errors
from realab_suite import sources
from realab_suite.engine import events
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.lab.verdicts import stakes
from tests import examples
from tests.evaluation import rows

_row, _info, _RESULT = rows.row, rows.info, rows.RESULT


def _write(path: pathlib.Path, *written: results.EpisodeResult) -> None:
  with results.RowWriter(path) as writer:
    for row in written:
      writer.write(row)


def test_a_row_holds_every_field_of_a_result():
  row = _row()
  added = {'settings', 'extras'}
  assert row.model_dump(exclude=added) == _RESULT.model_dump(exclude=added)
  assert row.info == _info()
  assert row.schema_version == 4
  assert stakes.of(row) == rows.STAKE


def test_a_row_is_read_as_it_was_written(tmp_path):
  made = [
      *(_row(end=end) for end in events.End),
      _row(episode=6, registers={}, facts={}),
  ]
  _write(tmp_path / 'rows', *made)
  assert list(results.read_rows(tmp_path / 'rows')) == made


_TEXT = st.text(st.characters(exclude_categories=['Cs']))


@hypothesis.settings(
    examples.settings(30),
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
@hypothesis.given(_TEXT)
@hypothesis.example('a\u2028b')
@hypothesis.example('a\x85b')
@hypothesis.example('a\nb\rc\x0bd\x1ee')
@hypothesis.example('Größe "x" \\')
def test_a_name_may_hold_any_character(tmp_path, name):
  made = [_RESULT.of_run(_info(run=name)), _row()]
  path = tmp_path / 'rows'
  path.unlink(missing_ok=True)
  _write(path, *made)
  assert list(results.read_rows(path)) == made


def test_an_unknown_content_is_text_in_a_file(tmp_path):
  unknown = {'return': gains.Value(observed=1.0, clean=math.nan)}
  _write(tmp_path / 'rows', _row(corruption=None, objective=unknown))
  line = json.loads((tmp_path / 'rows').read_text())
  assert line['corruption'] is None
  # Strict JSON has no nan.
  assert line['objective']['return']['clean'] == 'NaN'
  [again] = results.read_rows(tmp_path / 'rows')
  assert again.corruption is None
  assert math.isnan(again.objective['return'].clean)


def test_a_file_is_never_overwritten(tmp_path):
  path = tmp_path / 'rows'
  _write(path, _row())
  before = path.read_bytes()
  with pytest.raises(errors.ResultsError) as raised:
    results.RowWriter(path)
  assert str(raised.value) == f'cannot create {path}: File exists'
  assert path.read_bytes() == before


def test_each_row_is_in_the_file_before_the_next(tmp_path):
  path = tmp_path / 'rows'
  with results.RowWriter(path) as writer:
    assert list(results.read_rows(path)) == []
    for episode in range(3):
      writer.write(_row(episode=episode))
      found = [row.episode for row in results.read_rows(path)]
      assert found == list(range(episode + 1))


def _broken(change: Callable[[dict[str, Any]], Any]) -> str:
  line = json.loads(_row().model_dump_json(by_alias=True))
  change(line)
  return json.dumps(line)


_NO_ROWS = {
    'nothing': '',
    'half a row': _row().model_dump_json(by_alias=True)[:-9],
    'the former schema': _broken(lambda line: line.update(schema=3)),
    'an end that does not exist': _broken(lambda line: line.update(end='so')),
    'no settings of a run': _broken(lambda line: line.update(info=None)),
    'a field too many': _broken(lambda line: line.update(surprise=1)),
}


@pytest.mark.parametrize('problem', _NO_ROWS)
def test_a_wrong_row_is_named_by_its_line(tmp_path, problem):
  line = _NO_ROWS[problem]
  path = tmp_path / 'rows'
  good = _row().model_dump_json(by_alias=True)
  path.write_text(f'{good}\n{good}\n{line}\n{good}\n', encoding='utf-8')
  found = results.read_rows(path)
  assert [next(found), next(found)] == [_row(), _row()]
  with pytest.raises(errors.ResultsError) as raised:
    next(found)
  message = str(raised.value)
  assert message.startswith(f'{path}:3: not a row of schema 4: ')
  assert '\n' not in message
  if problem == 'a field too many':
    assert 'surprise' in message


@pytest.mark.parametrize('tail', [b'\0\0\0', None])
def test_a_torn_last_row_is_left_out_with_a_warning(tmp_path, tail):
  path = tmp_path / 'rows'
  made = [_row(), _row(episode=6)]
  _write(path, *made)
  if tail is None:
    tail = results.line(_row(episode=7))[:-2]
  path.write_bytes(path.read_bytes() + tail)
  with pytest.warns(UserWarning, match=rf'rows:3: .* {len(tail)} bytes'):
    assert list(results.read_rows(path)) == made


@pytest.mark.parametrize('content', [None, b'\xff\xfe\n'])
def test_a_file_that_cannot_be_read_is_named(tmp_path, content):
  path = tmp_path / 'rows'
  if content is not None:
    path.write_bytes(content)
  with pytest.raises(errors.ResultsError) as raised:
    list(results.read_rows(path))
  assert str(path) in str(raised.value)


def test_a_row_names_the_versions_that_it_depends_on():
  assert results.versions() == {
      'realab_suite': realab_suite.__version__,
      'code': sources.digest(),
      'python': platform.python_version(),
      'dm-control': results.metadata.version('dm-control'),
      'mujoco': mujoco.__version__,
      'numpy': np.__version__,
  }
  info = _row().info
  assert info.versions == results.versions_of_rows()
  assert info.platform == platform.platform()
  assert info.isolation == 'T0 in-process'


@pytest.mark.parametrize('is_stand_in', [False, True])
def test_rows_and_no_jobs_name_a_stand_in_for_labmaze(monkeypatch, is_stand_in):
  labmaze = types.ModuleType('labmaze')
  if is_stand_in:
    labmaze.STAND_IN = True
  monkeypatch.setitem(sys.modules, 'labmaze', labmaze)
  assert ('labmaze' in _row().info.versions) == is_stand_in
  # The identity of a job must not depend on what its process has imported.
  assert 'labmaze' not in results.versions()


def test_a_row_that_failed_is_not_written_again(tmp_path):
  path = tmp_path / 'rows.jsonl'
  writer = results.RowWriter(path)
  writer.write(_row())
  size = path.stat().st_size
  soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
  resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, hard))
  try:
    with pytest.raises(errors.ResultsError, match='File too large'):
      writer.write(_row())
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
  writer.close()
  assert path.stat().st_size == size + 50
  with pytest.warns(UserWarning, match='incomplete row of 50 bytes'):
    assert len(list(results.read_rows(path))) == 1


def test_a_last_row_without_its_newline_is_whole(tmp_path):
  path = tmp_path / 'episodes.jsonl'
  _write(path, _row(), _row(episode=6))
  path.write_bytes(path.read_bytes().rstrip(b'\n'))
  assert len([*results.read_rows(path)]) == 2

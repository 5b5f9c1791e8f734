"""Tests of folders of runs: lines, locks, checkpoints and errors."""

import errno
import json
import os
import pathlib

import pytest

from realab_suite import errors
from realab_suite.feedback import specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import storage

_HEADER = {'configuration': 'this'}
_LINES = [{'step': 1}, {'step': 2}]


def _lines(path: pathlib.Path) -> int:
  """Writes lines, and returns the size of the file."""
  file = storage.JsonLines(path, 0)
  file.append(_LINES)
  size = file.size
  file.close()
  return size


def test_lines_continue_from_the_size_at_a_checkpoint(tmp_path):
  path = tmp_path / 'lines'
  size = _lines(path)
  path.write_bytes(path.read_bytes() + b'{"step": 3}\n{"st')
  file = storage.JsonLines(path, size)
  file.append([{'step': 4}])
  assert file.size == path.stat().st_size
  file.close()
  steps = [json.loads(line)['step'] for line in path.read_text().splitlines()]
  assert steps == [1, 2, 4]


def test_missing_lines_are_refused(tmp_path):
  path = tmp_path / 'lines'
  size = _lines(path)
  path.write_bytes(path.read_bytes()[:-1])
  with pytest.raises(
      errors.ResultsError, match='lines: has 23 bytes; must have the 24 of the'
  ):
    storage.JsonLines(path, size)


@pytest.mark.parametrize('text', ['{"a":', '[' * 100_000])
def test_what_is_no_json_is_named(tmp_path, text):
  path = tmp_path / 'file'
  path.write_text(text)
  with pytest.raises(errors.ResultsError, match='file: not JSON: '):
    storage.read_json(path)


def _as_owner(path: pathlib.Path, mode: int) -> bool:
  """Is `os.access` for a user who is not root."""
  return path.exists() and path.stat().st_mode >> 6 & mode == mode


def _shared(folder: pathlib.Path) -> pathlib.Path:
  for name in ('lock', 'stakes/a.json', 'stakes/a.lock', 'logs/b-0.log',
               'b-0/config.json', 'b-0/lock', 'c-0/done.json'):  # fmt: skip
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).touch()
  return folder


@pytest.mark.parametrize(
    ('names', 'mode', 'what'),
    [
        (['.', 'stakes', 'stakes/a.json', 'b-0/config.json', 'c-0',
          'c-0/done.json'], 0o000, 'read'),
        (['.', 'lock', 'stakes', 'stakes/a.lock', 'logs/b-0.log', 'b-0'], 0o500,
         'written to'),
    ],
)  # fmt: skip
def test_a_folder_of_others_is_refused_before_any_work(
    monkeypatch, tmp_path, names, mode, what
):
  folder = _shared(tmp_path)
  monkeypatch.setattr(os, 'access', _as_owner)
  storage.check_access(folder)
  storage.check_access(folder / 'missing')
  for path in (folder / name for name in names):
    before = path.stat().st_mode
    path.chmod(mode)
    try:
      with pytest.raises(
          errors.ResultsError, match=f'{path}: cannot be {what}'
      ):
        storage.check_access(folder)
      with pytest.raises(
          errors.ResultsError, match=f'{path}: cannot be {what}'
      ):
        jobs.check_codes([], folder, True)
      if what == 'written to':
        storage.check_access(folder, is_written=False)
    finally:
      path.chmod(before)
  for name in ('c-0/done.json', 'c-0', 'stakes/a.json'):
    (folder / name).chmod(0o500)  # Of a finished job, or replaced as a whole.
  storage.check_access(folder)


def test_the_first_difference_is_named_by_its_place():
  there = {'a': {'b': 1, 'c': 2}}
  assert storage.difference(there, {'a': {'b': 1, 'c': 3}}) == (
      'a.c is 2 there, 3 here'
  )
  assert storage.difference(there, {'d': 0}).startswith('a is {')
  assert storage.difference({}, {'d': 0}) == 'd is None there, 0 here'
  # One has the key, with the value None.
  assert storage.difference({'a': {'b': None}}, {'a': {}}) == (
      "a is {'b': None} there, {} here"
  )


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
  path = tmp_path / 'file'
  storage.write_whole(path, b'old')

  def fail(source, target):
    raise OSError(errno.ENOSPC, 'No space left on device')

  monkeypatch.setattr(storage.os, 'replace', fail)
  with pytest.raises(
      errors.ResultsError, match=r'file: No space left .* space'
  ):
    storage.write_whole(path, b'new')
  assert path.read_bytes() == b'old'
  assert [one.name for one in tmp_path.iterdir()] == ['file']


def test_half_a_line_is_removed_when_a_file_is_opened_again(tmp_path):
  path = tmp_path / 'timing.jsonl'
  path.write_bytes(b'{"step": 1}\n{"st')
  for step in (2, 3):
    lines = storage.JsonLines(path)
    lines.append([{'step': step}])
    lines.close()
  assert path.read_text() == '{"step": 1}\n{"step": 2}\n{"step": 3}\n'


def test_a_folder_with_results_is_never_used_again(tmp_path):
  assert storage.new_folder(str(tmp_path / 'new')).is_dir()
  (tmp_path / 'new' / 'row').touch()
  with pytest.raises(errors.ResultsError, match='never overwritten; name anot'):
    storage.new_folder(str(tmp_path / 'new'))


@pytest.mark.parametrize(
    ('umask', 'mode'), [(0o002, 0o664), (0o022, 0o644), (0o077, 0o600)]
)
def test_a_group_that_shares_its_files_shares_locks(tmp_path, umask, mode):
  before = os.umask(umask)
  try:
    with storage.locked(tmp_path / 'new'):
      assert (tmp_path / 'new' / 'lock').stat().st_mode & 0o777 == mode
  finally:
    os.umask(before)


def test_home_folders_of_outputs_and_designs_are_expanded(
    tmp_path, monkeypatch
):
  monkeypatch.setenv('HOME', str(tmp_path))
  assert storage.new_folder('~/results') == tmp_path / 'results'
  design = specs.load('instantaneous_reward')
  (tmp_path / 'mine.yaml').write_text(json.dumps(design.to_mapping()))
  assert specs.load('~/mine.yaml') == design

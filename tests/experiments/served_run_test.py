"""Tests of the record of a served run: permissions, contents and errors."""

import json
import os

import pytest

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.experiments import served_run
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from tests.experiments import small

_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')


def _rewrite(path, change):
  """Changes a record, and gives it the checksum that it needs."""
  content = json.loads(path.read_text())
  del content['checksum']
  change(content)
  storage.write_sealed(path, content)
  path.chmod(0o600)


def test_a_record_repeats_the_world_and_its_salt(tmp_path):
  record = served_run.read(str(small.write_served_run(tmp_path, seed=2**70)))
  assert (record.seed, record.seed.salt) == (2**70, small.SALT)
  settings = record.settings
  assert (settings.domain, settings.task) == ('unlock_door', 'near')
  assert settings.max_steps == 12
  assert record.versions == results.versions()
  design = specs.load(record.design)
  assert design.registers['reward'].scale == 0.2


def test_printing_a_record_does_not_print_the_salt(tmp_path):
  record = served_run.read(str(small.write_served_run(tmp_path)))
  assert small.SALT.hex() not in f'{record} {record!r} {record.seed!r}'


@pytest.mark.parametrize('mode', [0o640, 0o604])
def test_a_record_that_others_can_open_is_refused(tmp_path, mode):
  path = small.write_served_run(tmp_path)
  path.chmod(mode)
  with pytest.raises(errors.SpecError, match=f'has mode {mode:04o}; allowed'):
    served_run.read(str(path))


@_is_root
def test_a_record_of_another_user_is_refused(tmp_path):
  path = small.write_served_run(tmp_path)
  os.chown(path, 65534, 65534)
  with pytest.raises(errors.SpecError, match='belongs to user 65534'):
    served_run.read(str(path))


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        (lambda r: r.pop('salt'), 'salt: required key is missing'),
        (lambda r: r.update(salt=None), 'salt: must be a valid string'),
        (lambda r: r.update(salt=''), 'salt: a text of '),
        (lambda r: r.update(salt='0' * 33), 'salt: a text of '),
        (lambda r: r.update(salt='0' * 31 + '\n'), 'salt: a text of '),
        (lambda r: r.update(salt='G' * 32), 'salt: a text of '),
        (lambda r: r.update(settings=5), 'settings: '),
        (lambda r: r['settings'].pop('task'), 'settings.task: required key'),
        (lambda r: r['settings'].update(seed=-1), 'settings.seed: must be'),
        (lambda r: r['settings'].update(seed=True), 'settings.seed: must be'),
        (lambda r: r['settings'].update(max_steps=0), 'settings.max_steps: '),
        (lambda r: r.update(design='x'), 'design: must be a mapping'),
        (lambda r: r.update(versions={'a': 1}), 'versions.a: must be'),
    ],
)
def test_a_wrong_record_is_refused_in_one_line(tmp_path, change, problem):
  path = small.write_served_run(tmp_path)
  _rewrite(path, change)
  with pytest.raises(errors.SpecError) as caught:
    served_run.read(str(path))
  assert f'{path}: {problem}' in str(caught.value)
  assert len(str(caught.value).splitlines()) == 1


def test_an_error_does_not_print_the_salt(tmp_path):
  path = small.write_served_run(tmp_path)
  _rewrite(path, lambda record: record.update(salt=record['salt'] + 'f'))
  with pytest.raises(errors.SpecError, match='salt: ') as caught:
    served_run.read(str(path))
  assert small.SALT.hex() not in str(caught.value)


@pytest.mark.parametrize('text', ['', '{', '[]', '5', '{"settings": {}}'])
def test_another_file_is_refused_in_one_line(tmp_path, text):
  path = tmp_path / 'run.json'
  path.write_text(text)
  path.chmod(0o600)
  with pytest.raises(errors.ResultsError, match=f'^{path}: '):
    served_run.read(str(path))


def test_a_missing_file_is_named(tmp_path):
  with pytest.raises(errors.ResultsError, match=r'run\.json: No such'):
    served_run.read(str(tmp_path / 'run.json'))


def test_a_folder_is_refused(tmp_path):
  tmp_path.chmod(0o700)
  with pytest.raises(errors.ResultsError, match='Is a directory'):
    served_run.read(str(tmp_path))

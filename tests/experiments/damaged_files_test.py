"""Campaign C23 in small, and that it can fail."""

import json
import pathlib
import pickle
import shutil
from typing import Any

import numpy as np
import pytest

from campaigns import files_campaign
from realab_suite import errors
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.reports import sweep_results
from tests.experiments import fake_sweep

_EVENTS = files_campaign.Events()


def test_no_damaged_file_is_taken_for_what_was_written():
  found = files_campaign.run(200, 2, _EVENTS)
  for name, figures in found.items():
    assert not figures.first, name
    assert figures.refused > 0.6 * figures.tried, name
  assert not _EVENTS.heard


def test_a_file_without_a_checksum_is_caught(tmp_path: pathlib.Path):
  path = tmp_path / 'plain.json'
  path.write_text(json.dumps({'numbers': list(range(100))}))
  kind = files_campaign.Kind('plain', path, lambda: storage.read_json(path))
  found = files_campaign.judge(kind, [b'{}'], 60, np.random.default_rng(0))
  assert found.undetected


def test_a_pickle_that_is_read_is_heard_of(tmp_path: pathlib.Path):
  with _EVENTS:
    pickle.loads(pickle.dumps(pathlib.PurePath('x')))
  assert 'pickle.find_class' in _EVENTS.heard


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  folder = tmp_path_factory.mktemp('built')
  return fake_sweep.build(folder, fake_sweep.experiment(seeds=[0]))


@pytest.fixture
def sweep(built: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
  return pathlib.Path(shutil.copytree(built, tmp_path / 'sweep'))


def _edit(path: pathlib.Path, old: str, new: str) -> None:
  text = path.read_text(encoding='utf-8')
  assert old in text
  path.write_text(text.replace(old, new, 1), encoding='utf-8')


def test_a_changed_description_of_a_sweep_is_refused(sweep: pathlib.Path):
  _edit(sweep / scheduler.SWEEP, '"calibration": false', '"calibration": true')
  with pytest.raises(errors.ResultsError, match='its checksum does not match'):
    sweep_results.load(sweep)


def test_a_changed_experiment_of_a_sweep_is_refused(sweep: pathlib.Path):
  _edit(sweep / scheduler.EXPERIMENT, '250', '251')
  with pytest.raises(errors.ResultsError, match='since the sweep began'):
    sweep_results.load(sweep)


def test_a_changed_configuration_of_a_run_is_refused(sweep: pathlib.Path):
  folder, *_ = sorted(p for p in sweep.iterdir() if (p / 'done.json').exists())
  _edit(folder / storage.CONFIG, '"max_steps": 250', '"max_steps": 251')
  with pytest.raises(errors.ResultsError, match='name of its folder'):
    sweep_results.load(sweep)


def test_a_job_of_a_sweep_is_a_folder_beside_its_file(sweep: pathlib.Path):
  content: Any = scheduler.read_description(sweep)
  content['jobs'][0]['folder'] = '../elsewhere'
  storage.write_sealed(sweep / scheduler.SWEEP, content)
  with pytest.raises(errors.ResultsError, match=r'jobs\.0\.folder'):
    sweep_results.load(sweep)

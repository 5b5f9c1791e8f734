"""Tests of errors about files whose contents do not fit their names."""

import contextlib
import pathlib
import shutil
from typing import Any

import numpy as np
import pytest

from realab_suite import archive
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import storage
from realab_suite.experiments import training
from realab_suite.reports import sweep_results
from tests.experiments import fake_learner
from tests.experiments import fake_sweep

_CHECKPOINT = 'checkpoint'


def _experiment(**changes: Any) -> experiment_specs.ExperimentSpec:
  return fake_sweep.experiment(seeds=[0], **changes)


def _job(one: experiment_specs.ExperimentSpec) -> jobs.Job:
  [job] = jobs.plan(one, only=['reward'])
  return job


def _files(folder: pathlib.Path, one: experiment_specs.ExperimentSpec) -> None:
  """Writes a file of each kind, of the same job."""
  job = _job(one)
  folder.mkdir()
  with storage.RunFolder(folder / 'run', {}) as run:
    header = training.header(job.digest(), _CHECKPOINT)
    run.save(1, header, {'done': 1})
  [checkpoint] = (folder / 'run' / 'checkpoints').iterdir()
  shutil.move(checkpoint, folder / _CHECKPOINT)
  learner = {'num_steps': 3, 'blend': np.zeros(2)}
  for name, contents in (
      (training.LEARNER, learner),
      (training.TRACE, {'actions': np.zeros(2)}),
  ):
    header = training.header(job.digest(), name)
    storage.write_archive(folder / name, header, contents)
  env = suite.load('unlock_door', 'near', {'random': 0})
  env.reset()
  (folder / 'snapshot').write_bytes(env.save().to_bytes())
  env.close()


@pytest.fixture(scope='module', name='sweep')
def _sweep(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The folder of a sweep, with a file of each kind beside it."""
  folder = tmp_path_factory.mktemp('wrong')
  one = _experiment()
  fake_sweep.build(folder / 'sweep', one)
  _files(folder / 'own', one)
  _files(folder / 'other', _experiment(max_steps=251))
  return folder


_NAMES = [_CHECKPOINT, training.LEARNER, training.TRACE]
# Kinds of the files in errors.
_HOLDS = {
    **{name: repr(name) for name in _NAMES},
    'snapshot': "'snapshot'",
}


def _read(name: str, sweep: pathlib.Path) -> pathlib.Path:
  """Reads the file of a name, as the programs do; returns its path."""
  job = _job(_experiment())
  folder = sweep / 'sweep' / job.folder()
  if name == _CHECKPOINT:
    with storage.RunFolder(folder, job.config()) as run:
      run.load(training.header(job.digest(), _CHECKPOINT))
  elif name == training.LEARNER:
    with contextlib.closing(training.load_batch(job, 2, 0)) as batch:
      training.load_learner(job, folder, batch)
  else:
    run = sweep_results.load(sweep / 'sweep').runs['reward']
    assert run.traces
  return folder


def _place(name: str, sweep: pathlib.Path) -> pathlib.Path:
  folder = sweep / 'sweep' / _job(_experiment()).folder()
  if name == _CHECKPOINT:
    (folder / 'checkpoints').mkdir(exist_ok=True)
    return folder / 'checkpoints' / '000000000001.ckpt'
  return folder / name


def _complaint(
    name: str, sweep: pathlib.Path, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> str:
  """Returns the error about a file with these bytes, less its path."""
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)
  # The digests in done.json would refuse the file first, with less detail.
  monkeypatch.setattr(storage, 'is_done', lambda path: True)
  path = _place(name, sweep)
  before = path.read_bytes() if path.exists() else None
  path.write_bytes(data)
  try:
    with pytest.raises(errors.ResultsError) as raised:
      _read(name, sweep)
  finally:
    path.unlink()
    if before is not None:
      path.write_bytes(before)
  message = str(raised.value)
  assert message.startswith(f'{path}: ')
  assert '\n' not in message
  assert 'environment' not in message
  return message.removeprefix(f'{path}: ')


@pytest.mark.parametrize(
    ('name', 'held'),
    [
        (_CHECKPOINT, training.LEARNER),
        (training.LEARNER, 'snapshot'),
        (training.TRACE, _CHECKPOINT),
    ],
)
def test_the_error_on_a_file_of_another_kind_names_both_kinds(
    sweep, monkeypatch, name, held
):
  data = (sweep / 'own' / held).read_bytes()
  message = _complaint(name, sweep, data, monkeypatch)
  assert f'holds {_HOLDS[held]}; expected {_HOLDS[name]}' in message


@pytest.mark.parametrize(
    'name', [_CHECKPOINT, training.LEARNER, training.TRACE]
)
def test_the_error_on_a_file_of_another_run_names_both_configurations(
    sweep, monkeypatch, name
):
  data = (sweep / 'other' / name).read_bytes()
  message = _complaint(name, sweep, data, monkeypatch)
  theirs, ours = (
      _job(one).digest() for one in (_experiment(max_steps=251), _experiment())
  )
  assert (
      f'holds {name!r} with another header: configuration is {theirs!r} in the'
      f' file, {ours!r} expected'
  ) in message


@pytest.mark.parametrize(
    ('name', 'damage'),
    [
        (_CHECKPOINT, 'empty'),
        (_CHECKPOINT, 'flipped'),
        (training.LEARNER, 'text'),
        (training.TRACE, 'cut'),
    ],
)
def test_the_error_on_a_damaged_file_names_the_expected_kind(
    sweep, monkeypatch, name, damage
):
  data = bytearray((sweep / 'own' / name).read_bytes())
  if damage == 'empty':
    data.clear()
  elif damage == 'text':
    data[:] = b'{"num_steps": 3}'
  elif damage == 'cut':
    del data[len(data) // 2 :]
  else:
    data[-1] ^= 1
  message = _complaint(name, sweep, bytes(data), monkeypatch)
  assert f'{len(data)} bytes are not a valid {_HOLDS[name]}' in message


def test_the_error_on_a_learner_that_does_not_fit_names_its_file(
    sweep, tmp_path, monkeypatch
):
  job = _job(_experiment())
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)

  def refuse(self: Any, state: Any) -> None:
    raise errors.StateLayoutError('state of a learner: too wide')

  monkeypatch.setattr(fake_learner.FakeLearner, 'set_state', refuse)
  shutil.copy(sweep / 'own' / training.LEARNER, tmp_path)
  with (
      contextlib.closing(training.load_batch(job, 2, 0)) as batch,
      pytest.raises(
          errors.ResultsError,
          match=r'learner\.bin: state of a learner: too wide',
      ),
  ):
    training.load_learner(job, tmp_path, batch)


def test_an_archive_of_a_run_is_refused_as_a_snapshot(sweep):
  data = (sweep / 'own' / training.LEARNER).read_bytes()
  with pytest.raises(
      errors.StateLayoutError,
      match=f"contains '{training.LEARNER}'; expected a snapshot",
  ):
    snapshots.Snapshot.from_bytes(data)


def test_a_snapshot_is_an_archive(sweep):
  data = (sweep / 'own' / 'snapshot').read_bytes()
  read = archive.Archive.from_bytes(data)
  assert read.what == 'snapshot'
  assert read.to_bytes() == data

"""Tests that finished jobs are not run again."""

import functools
import pathlib
import shutil
from typing import Any

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import engines
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import result_folders
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_sweep


class _Idle(engines.Engine):
  """An engine for jobs that are all done."""

  capacity = 1

  def __init__(self) -> None:
    self.commands: list[Any] = []

  def start(self, command: Any, log: pathlib.Path) -> Any:
    self.commands.append(command)
    log.write_text('error: not done, but started\n')

  def poll(self, task: Any) -> int:
    return 1

  def stop(self, tasks: Any) -> None:
    """Does nothing."""


@functools.cache
def _experiment() -> experiment_specs.ExperimentSpec:
  return fake_sweep.experiment(seeds=[0], baselines=['random'])


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(scheduler, '_POLL_SECONDS', 0.0)


@pytest.fixture(scope='module', name='built')
def _built(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  return fake_sweep.build(tmp_path_factory.mktemp('built'), _experiment())


@pytest.fixture(name='folder')
def _folder(built: pathlib.Path, tmp_path: pathlib.Path) -> pathlib.Path:
  return pathlib.Path(shutil.copytree(built, tmp_path / 'sweep'))


def _job_folder(folder: pathlib.Path, run: str = 'reward') -> pathlib.Path:
  [job] = jobs.plan(_experiment(), only=[run])
  return folder / job.folder()


def _sweep(folder: pathlib.Path, *only: str) -> _Idle:
  engine = _Idle()
  scheduler.sweep(_experiment(), folder, engine, lambda line: None, only=only)
  return engine


def _report(folder: pathlib.Path) -> None:
  """Reads everything that a report shows."""
  sweep = result_folders.load(folder)
  for run in sweep.runs.values():
    assert run.is_done
    assert run.traces
    assert run.design
    assert run.curves is not None
    assert run.training_episodes() is not None


def test_the_folder_of_another_job_is_refused(folder):
  mine, other = _job_folder(folder), _job_folder(folder, 'reward.secure')
  shutil.rmtree(mine)
  shutil.copytree(other, mine)
  with pytest.raises(errors.ResultsError):
    _report(folder)


def test_a_job_without_done_json_is_run_again(folder):
  (_job_folder(folder) / storage.DONE).unlink()
  with pytest.raises(errors.ResultsError, match='not done, but started'):
    _sweep(folder, 'reward')
  sweep = result_folders.load(folder)
  assert [job.run for job in sweep.unfinished] == ['reward']


def test_an_undamaged_sweep_is_done_and_its_timing_may_change(folder):
  (_job_folder(folder) / training.TIMING).write_text(
      '{"step": 8, "seconds": 1}\n'
  )
  assert not _sweep(folder).commands
  _report(folder)

"""Tests of the engines of sweeps, with stand-ins for the clusters.

`campaigns.kills_campaign` runs sweeps on the real ones.
"""

import os
import pathlib
import signal
import subprocess
import sys
import types

import pytest

from realab_suite import errors
from realab_suite.lab.experiments import engines
from tests import patience


def test_an_engine_that_is_not_installed_says_what_to_install(monkeypatch):
  monkeypatch.setattr('importlib.util.find_spec', lambda name: None)
  for name in ('ray', 'submitit'):
    with pytest.raises(
        errors.SpecError,
        match=rf'--engine={name}: .*pip install -e .\.\[cluster\]',
    ):
      engines.ENGINES[name](1)


def _command(status):
  # A command ends with the process that runs it, whose number it gets.
  text = f'import sys; print(sys.argv[1:]); raise SystemExit({status})'
  return [sys.executable, '-c', text]


_SAID = f"['--parent={os.getpid()}']\n"


def _wait(engine, task):
  statuses = []

  def has_ended():
    statuses.append(engine.poll(task))
    return statuses[-1] is not None

  patience.until(has_ended)
  return statuses[-1]


def test_the_local_engine_returns_the_exit_status_and_stops_commands(
    tmp_path, monkeypatch
):
  monkeypatch.setattr(engines, '_PATIENCE', patience.SECONDS)
  engine = engines.Local(1)
  log = tmp_path / 'log'
  for status in (0, 3):
    assert _wait(engine, engine.start(_command(status), log)) == status
  assert log.read_text() == 2 * _SAID
  command = [sys.executable, '-c', 'import time; time.sleep(1e6)']
  task = engine.start(command, pathlib.Path(os.devnull))
  assert engine.poll(task) is None
  engine.stop([task])
  assert engine.poll(task) == -signal.SIGTERM


class _FakeRay(types.ModuleType):
  """As much of ray as the engine needs, done at once."""

  def init(self, **unused):
    pass

  def remote(self, **unused):
    def decorate(function):
      return types.SimpleNamespace(
          remote=lambda *arguments: lambda: function(*arguments)
      )

    return decorate

  def wait(self, tasks, timeout):
    assert timeout == 0
    return tasks, []

  def get(self, task):
    return task()


class _FakeExecutor:

  def __init__(self, folder):
    assert pathlib.Path(folder).is_dir()

  def update_parameters(self, *, timeout_min, **unused):
    assert timeout_min >= 60  # Left alone, it is five.

  def submit(self, function, *arguments):
    return types.SimpleNamespace(
        done=lambda: True, result=lambda: function(*arguments)
    )


@pytest.mark.parametrize('name', ['ray', 'submitit'])
def test_a_cluster_runs_the_same_commands(tmp_path, monkeypatch, name):
  fake = _FakeRay('ray')
  if name == 'submitit':
    fake = types.ModuleType(name)
    fake.AutoExecutor = _FakeExecutor
  monkeypatch.setitem(sys.modules, name, fake)
  monkeypatch.setattr('importlib.util.find_spec', lambda name: fake)
  engine = engines.ENGINES[name](1)
  log = tmp_path / 'log'
  assert _wait(engine, engine.start(_command(3), log)) == 3
  assert log.read_text() == _SAID


def test_a_job_that_slurm_lost_or_no_longer_has(monkeypatch):
  fake = types.ModuleType('submitit')
  monkeypatch.setitem(sys.modules, 'submitit', fake)
  monkeypatch.setattr('importlib.util.find_spec', lambda name: fake)
  cancelled = []

  def fail():
    raise RuntimeError('Job 7 (task: 0)\nhas not produced any output')

  def cancel(check=True):
    cancelled.append(check)
    if check:
      raise subprocess.CalledProcessError(1, 'scancel')

  task = types.SimpleNamespace(
      done=lambda: bool(cancelled), result=fail, cancel=cancel
  )
  engine = engines.Submitit(1)
  assert engine.poll(task) is None
  engine.stop([task, task])
  assert cancelled == [False, False]
  with pytest.raises(errors.ResultsError, match=r'=submitit: .*Job 7'):
    engine.poll(task)


def test_an_error_of_ray_is_one_line(tmp_path, monkeypatch):
  fake = _FakeRay('ray')

  def fail(task):
    raise RuntimeError('a machine\nis gone')

  fake.get = fail
  monkeypatch.setitem(sys.modules, 'ray', fake)
  monkeypatch.setattr('importlib.util.find_spec', lambda name: fake)
  engine = engines.Ray(1)
  task = engine.start(_command(0), tmp_path / 'log')
  with pytest.raises(errors.ResultsError, match='--engine=ray: RuntimeError'):
    engine.poll(task)

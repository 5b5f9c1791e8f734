"""Tests of runs that continue on another machine, and of its description."""

import functools
import json
import os
import pathlib
import subprocess
import sys
from typing import Any

import pytest
import yaml

from realab_suite import errors
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import machines
from realab_suite.experiments import storage
from realab_suite.experiments import threads
from realab_suite.experiments import training
from tests import patience
from tests.experiments import fake_learner

_ROOT = pathlib.Path(__file__).parents[2]
_NUM_ENVS = 2
_SMALL = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'max_steps': 9,
    'runs': {'reward': {'design': 'instantaneous_reward'}},
    'baselines': ['random'],
    'seeds': [3],
    'training': {
        'num_envs': _NUM_ENVS,
        'steps': 40 * _NUM_ENVS,
        'checkpoint_every': 10 * _NUM_ENVS,
        'curve_every': 10 * _NUM_ENVS,
    },
    'evaluation': {'episodes': 2},
}


class Killed(BaseException):
  """Ends a run as suddenly as a signal, within this process."""


@functools.cache
def _job(run: str = 'reward') -> jobs.Job:
  [job] = jobs.plan(experiment_specs.load(_SMALL), only=[run])
  return job


@pytest.fixture(name='on')
def _on(monkeypatch: pytest.MonkeyPatch) -> Any:
  """Runs the small job, on a machine of a name and up to a step."""

  def on(
      machine: str,
      output: pathlib.Path,
      kill_at: int | None = None,
      **options: Any,
  ) -> list[str]:
    said: list[str] = []

    def make(job: Any, batch: Any) -> fake_learner.FakeLearner:
      learner = fake_learner.make(job, batch)

      def on_step(step: int) -> None:
        if step == kill_at:
          raise Killed

      learner.on_step = on_step
      return learner

    monkeypatch.setattr(training, 'make_learner', make)
    monkeypatch.setattr(
        machines, 'here', lambda: {'processor': machine, 'libc': 'glibc 2.36'}
    )
    run = training.Options(said.append, **options)
    if kill_at is None:
      training.run(_job(), output, run)
    else:
      with pytest.raises(Killed):
        training.run(_job(), output, run)
    return said

  return on


def _results(output: pathlib.Path) -> dict[str, bytes]:
  """Returns all results except times and machines."""
  folder = output / _job().folder()
  return {
      path.name: path.read_bytes()
      for path in folder.iterdir()
      if path.is_file()
      and path.name not in (storage.DONE, training.TIMING, 'lock')
  }


def _machines(output: pathlib.Path) -> list[tuple[int, str]]:
  done = json.loads((output / _job().folder() / storage.DONE).read_text())
  return [(e['step'], e['machine']['processor']) for e in done['machines']]


def _warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
  return [one.message for one in caplog.records if one.levelname == 'WARNING']


def test_every_machine_of_a_run_is_recorded_once(on, tmp_path, caplog):
  on('b', tmp_path, kill_at=15)
  on('c', tmp_path, kill_at=14)  # Leaves nothing.
  on('b', tmp_path, kill_at=25)
  on('a', tmp_path, kill_at=34)
  caplog.clear()
  on('b', tmp_path)
  assert _warnings(caplog) == [
      'reward, seed 3: continues from step 60 on another machine or with other'
      " settings, and its results depend on both: processor is 'a' there, 'b'"
      ' here'
  ]
  assert _machines(tmp_path) == [(0, 'b'), (40, 'a'), (60, 'b')]


def test_a_run_continues_on_its_machine_without_a_warning(on, tmp_path, caplog):
  on('old', tmp_path, kill_at=25)
  on('old', tmp_path)
  on('old', tmp_path / 'whole')
  assert not _warnings(caplog)
  assert _machines(tmp_path) == [(0, 'old')]
  assert _results(tmp_path) == _results(tmp_path / 'whole')
  done = [
      (output / _job().folder() / storage.DONE).read_bytes()
      for output in (tmp_path, tmp_path / 'whole')
  ]
  assert done[0] == done[1]


def test_settings_of_the_learner_are_part_of_the_machine(
    on, tmp_path, monkeypatch, caplog
):
  on('same', tmp_path, kill_at=25)
  monkeypatch.setattr(
      fake_learner.FakeLearner, 'settings', lambda self: {'device': 'gpu'}
  )
  on('same', tmp_path)
  assert "device is None there, 'gpu' here" in _warnings(caplog)[0]


def test_the_machine_of_a_scripted_policy_is_recorded(tmp_path, monkeypatch):
  monkeypatch.setattr(machines, 'here', lambda: {'processor': 'mine'})
  job = _job('reward.random')
  path = training.run(job, tmp_path, training.Options(lambda line: None))
  done = json.loads((path / storage.DONE).read_text())
  assert done['machines'] == [{'step': 0, 'machine': {'processor': 'mine'}}]


# ---- Descriptions -----------------------------------------------------------


def test_the_description_of_a_machine_is_stable_plain_data():
  here = machines.here()
  assert json.loads(json.dumps(here)) == here == machines.here()
  assert machines.differences(here, here) == ''
  assert here['processor']
  assert here['system'].startswith(('Linux ', 'Darwin '))


@pytest.mark.parametrize(
    'name', ['GLIBC_TUNABLES', 'OPENBLAS_CORETYPE', 'ONEDNN_MAX_CPU_ISA',
             'DNNL_MAX_CPU_ISA', 'XLA_FLAGS'],
)  # fmt: skip
def test_a_variable_that_changes_results_is_described(monkeypatch, name):
  monkeypatch.delenv(name, raising=False)
  before = machines.here()
  monkeypatch.setenv(name, '--something=else')
  assert machines.differences(before, machines.here()) == (
      f"{name} is '' there, '--something=else' here"
  )


def test_the_number_of_threads_that_programs_set_is_no_difference(monkeypatch):
  for name in (*threads._ONE, 'XLA_FLAGS'):
    monkeypatch.setenv(name, '')
  before = machines.here()
  threads.use_one()
  assert machines.here() == before


@pytest.mark.parametrize(
    ('text', 'processor'),
    [
        ('processor : 0\nmodel name\t: Xeon 3\nflags : a b\n', 'Xeon 3'),
        ('CPU implementer : 0x41\nCPU part\t: 0xd0c\n', '0xd0c'),
        (None, 'fallback'),
    ],
)
def test_the_processor_is_named(tmp_path, monkeypatch, text, processor):
  path = tmp_path / 'cpuinfo'
  if text is not None:
    path.write_text(text)
  monkeypatch.setattr(machines, '_CPU_INFO', path)
  monkeypatch.setattr(machines.platform, 'processor', lambda: 'fallback')
  assert machines.here()['processor'] == processor


# ---- Threads ----------------------------------------------------------------


@pytest.mark.parametrize(
    'given', ['', '--xla_cpu_max_isa=AVX2', '--a=1   --b=2', '--a']
)
def test_xla_flags_are_kept_and_one_thread_is_added(monkeypatch, given):
  monkeypatch.setattr(os, 'environ', {'XLA_FLAGS': given})
  for _ in range(2):  # A sweep does it, and then each of its runs.
    threads.use_one()
    assert os.environ['XLA_FLAGS'].split() == [
        *given.split(), '--xla_cpu_multi_thread_eigen=false',
    ]  # fmt: skip
    assert threads.xla_flags() == given.split()


def test_wrong_xla_flags_are_refused(monkeypatch):
  monkeypatch.setattr(os, 'environ', {'XLA_FLAGS': '--a=1 b=1'})
  with pytest.raises(errors.SpecError, match="XLA_FLAGS: 'b=1'"):
    threads.use_one()


# ---- Programs ---------------------------------------------------------------


def _launch(*arguments: str, **environment: str) -> Any:
  return subprocess.run(
      [sys.executable, '-m', 'tests.experiments.fake_learner', *arguments],
      cwd=_ROOT,
      env={**os.environ, **environment},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )


def test_a_program_warns_of_other_settings_in_one_line(tmp_path):
  file = tmp_path / 'small.yaml'
  file.write_text(yaml.safe_dump(_SMALL))
  arguments = [f'--experiment={file}', '--run=reward', '--seed=3']
  output = f'--output={tmp_path / "out"}'
  killed = _launch(*arguments, output, KILL_AT='25')
  assert killed.returncode < 0
  isa = '--xla_cpu_max_isa=AVX2'
  continued = _launch(*arguments, output, XLA_FLAGS=isa)
  assert continued.returncode == 0, continued.stderr
  [line] = [one for one in continued.stderr.splitlines() if isa in one]
  assert 'continues from step 40 on another machine' in line

"""Tests of the command `realab` and of the doctor."""

import configparser
import importlib
import importlib.util
import pathlib
import re
import runpy
import subprocess
import sys
from typing import Any

import pytest

import realab_suite
from realab_suite.launchers import command
from realab_suite.launchers import doctor

_ROOT = pathlib.Path(__file__).parents[2]


def _setup_cfg() -> configparser.ConfigParser:
  parser = configparser.ConfigParser()
  parser.read(_ROOT / 'setup.cfg')
  return parser


@pytest.fixture
def realab(monkeypatch):
  """Returns a function that runs the command, up to the launcher."""
  started: list[Any] = []
  monkeypatch.setattr(
      runpy, 'run_module', lambda name, **_: started.append((name, sys.argv))
  )

  def run(*arguments: str) -> tuple[int, list[Any]]:
    monkeypatch.setattr(sys, 'argv', ['realab', *arguments])
    monkeypatch.setattr(sys, 'path', list(sys.path))
    return command.main(), started

  return run


def test_the_command_is_installed():
  scripts = _setup_cfg()['options.entry_points']['console_scripts']
  name, _, target = scripts.strip().partition(' = ')
  module, _, function = target.partition(':')
  assert name == 'realab'
  assert getattr(importlib.import_module(module), function) is command.main


def test_there_is_a_subcommand_for_every_launcher():
  folder = pathlib.Path(command.__file__).parent
  launchers = {
      path.stem
      for path in folder.glob('*.py')
      if 'program.start(main)' in path.read_text()
  }
  assert set(command.COMMANDS) == launchers


def test_a_subcommand_runs_its_launcher_with_its_flags(realab):
  status, started = realab('sweep', '--experiment=quick', '--output=x')
  assert status == 0
  assert started == [
      (
          'realab_suite.launchers.sweep',
          ['sweep', '--experiment=quick', '--output=x'],
      )
  ]
  _, started = realab('doctor')
  assert started[-1] == ('realab_suite.launchers.doctor', ['doctor'])


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['hepl'], "command 'hepl' is unknown; did you mean 'help'?; "),
        (['repot'], "command 'repot' is unknown; did you mean 'report'?; "),
        (['--experiment=quick'], "command '--experiment=quick' is unknown; kn"),
    ],
)
def test_mistakes_are_reported_in_one_line(realab, capsys, arguments, message):
  assert realab(*arguments) == (2, [])
  out, err = capsys.readouterr()
  assert out == ''
  assert err.startswith(f'error: {message}')
  assert err.count('\n') == 1


def test_help_lists_every_subcommand(realab, capsys):
  assert realab('--help') == (0, [])
  shown = capsys.readouterr().out
  assert realab() == (2, [])
  assert capsys.readouterr().out == shown
  for name, purpose in command.COMMANDS.items():
    assert f'  {name:14} {purpose}\n' in shown


def test_each_subcommand_has_help(realab):
  _, started = realab('help', 'audit')
  assert started == [('realab_suite.launchers.audit', ['audit', '--help'])]


def test_the_version_is_printed(realab, capsys):
  assert realab('--version') == (0, [])
  assert capsys.readouterr().out == f'realab_suite {realab_suite.__version__}\n'


# The doctor.


def _processes(monkeypatch: Any, status: int, stderr: str = '') -> None:
  monkeypatch.setattr(doctor.requirements, 'missing', lambda *_, **__: None)
  monkeypatch.setattr(
      subprocess,
      'run',
      lambda arguments, **_: subprocess.CompletedProcess(
          arguments, status, '', stderr
      ),
  )


def test_a_good_installation(monkeypatch, capsys):
  _processes(monkeypatch, 0)
  monkeypatch.setenv('MUJOCO_GL', 'egl')
  assert doctor.main() == 0
  shown = capsys.readouterr().out
  assert re.match(r'Python 3\.\d+\.\d+, realab-suite ', shown)
  assert 'ok  core       works' in shown
  assert 'ok  rendering  works with MUJOCO_GL=egl\n' in shown
  assert 'ok  learners   work' in shown
  assert 'to repair' not in shown


def test_a_bad_installation(monkeypatch, capsys):
  _processes(monkeypatch, 1, 'Traceback\nImportError: no libmujoco\n')
  monkeypatch.setenv('MUJOCO_GL', 'egl')
  assert doctor.main() == 1
  shown = capsys.readouterr().out
  assert (
      '--  core       cannot step a world: ImportError: no libmujoco' in shown
  )
  assert '--  learners   cannot make one: ' in shown
  assert '--  rendering  no camera works: MUJOCO_GL=egl (ImportError' in shown
  assert 'apt install libegl1' in shown


def test_the_doctors_world_can_be_stepped():
  names: dict[str, Any] = {}
  exec(compile(doctor._STEPS_A_WORLD, 'doctor', 'exec'), names)
  assert names['env'].physics.time() > 0


def test_the_doctors_learner_can_be_made():
  pytest.importorskip('jax')
  names: dict[str, Any] = {}
  exec(compile(doctor._MAKES_A_LEARNER, 'doctor', 'exec'), names)
  assert names['learner'].num_steps == 0

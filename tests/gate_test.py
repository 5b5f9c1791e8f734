"""The gate lets nothing through, and nothing good is stopped."""

import os
import pathlib
import subprocess
import sys

import mujoco
import pytest

from tests import gate
from tests import patience

_ROOT = pathlib.Path(__file__).parents[1]
_CONFTEST = """
from tests import gate

def pytest_configure(config):
  config.pluginmanager.register(gate.Gate(), 'gate')
"""
_TESTS = """
import atexit
import mujoco
import pytest

def break_down():
  model = mujoco.MjModel.from_xml_string(
      '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody>'
      '</mujoco>')
  data = mujoco.MjData(model)
  data.qpos[0] = float('nan')
  mujoco.mj_step(model, data)

def test_quiet():
  pass

def test_bad_physics():
  break_down()

@pytest.mark.mujoco_warns('BADQPOS')
def test_announced_physics():
  break_down()

@pytest.mark.mujoco_warns('BADQVEL')
def test_another_was_announced():
  break_down()

@pytest.mark.mujoco_warns('BADQPOS')
def test_fails_otherwise():
  break_down()
  raise ZeroDivisionError

@pytest.fixture
def broken():
  yield
  break_down()

def test_bad_fixture(broken):
  pass

def test_open_file():
  open('some_file', 'w')

class Raising:
  def __del__(self):
    raise ZeroDivisionError('in a destructor')

def test_unraisable():
  Raising()

def test_bad_exit():
  atexit.register(lambda: 1 / 0)
"""
_PASS = ('test_quiet', 'test_announced_physics', 'test_bad_exit')
_FAIL = (
    'test_bad_physics',
    'test_another_was_announced',
    'test_fails_otherwise',
    'test_open_file',
    'test_unraisable',
)


def test_unannounced_warnings_fail_their_test_and_errors_at_exit_the_run(
    tmp_path,
):
  (tmp_path / 'conftest.py').write_text(_CONFTEST)
  (tmp_path / 'planted_test.py').write_text(_TESTS)
  (tmp_path / 'pytest.ini').write_text(
      '[pytest]\nfilterwarnings = error\npython_files = *_test.py\n'
      'addopts = -p no:cacheprovider -p no:randomly\n'
  )
  inherited = {
      name: value
      for name, value in os.environ.items()
      if not name.startswith('PYTEST_')
  }

  def run(only: str) -> tuple[int, str, str]:
    ran = subprocess.run(
        [sys.executable, '-m', 'pytest', '-v', '-k', only, str(tmp_path)],
        cwd=tmp_path,
        env={**inherited, 'PYTHONPATH': str(_ROOT)},
        capture_output=True,
        text=True,
        timeout=patience.SECONDS,
        check=False,
    )
    return ran.returncode, ran.stdout, ran.stderr

  status, out, _ = run('not exit')
  assert status == 1
  for name in _FAIL:
    assert f'{name} FAILED' in out, out
  for name in _PASS[:2]:
    assert f'{name} PASSED' in out, out
  assert 'test_bad_fixture ERROR' in out, out
  # The errors are those of the fixture alone.
  assert '5 failed, 3 passed, 1 deselected, 1 error' in out, out
  # Tests that pass, with and without an error at exit.
  status, out, _ = run('quiet or announced_physics')
  assert (status, '2 passed' in out) == (0, True)
  status, out, err = run('exit')
  assert (status, '1 passed' in out) == (1, True)
  assert 'ZeroDivisionError' in err


@pytest.mark.parametrize('name', gate.MESSAGES)
def test_every_warning_of_mujoco_has_a_name(name):
  kind = getattr(mujoco.mjtWarning, f'mjWARN_{name}')
  assert gate.name_of(mujoco.mju_warningText(int(kind), 3)) == name

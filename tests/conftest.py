"""Settings of every test: no GL by default, and profiles of hypothesis.

Tests run with `MUJOCO_GL=disable`. A test that renders is marked `camera`; all
those of a file run in another process with `MUJOCO_GL=egl`, because dm_control
chooses the renderer when it is imported. They are skipped without EGL.

What JAX compiles is kept in `.pytest_cache`, so that it is compiled once, also
for later runs and for the processes of jobs. `pytest --cache-clear` forgets it.

`REALAB_HYPOTHESIS_PROFILE` selects the examples of property tests: `ci`, the
default, has few and the same ones in every run; `long` has many random ones.
"""

import functools
import gc
import os
import pathlib
import subprocess
import sys

# Before anything imports dm_control.
os.environ.setdefault('MUJOCO_GL', 'disable')
os.environ['no_proxy'] = 'localhost,127.0.0.1'
# JAX would leave out what compiles in a second.
os.environ.setdefault('JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS', '0')

import hypothesis
import pytest

from realab_suite.lab.experiments import machines
from tests import gate
from tests import patience

_ROOT = pathlib.Path(__file__).parents[1]
machines.keep_compiled(_ROOT / '.pytest_cache' / 'd')

_HYPOTHESIS = {
    'deadline': None,
    'database': None,
    'suppress_health_check': [hypothesis.HealthCheck.too_slow],
}
hypothesis.settings.register_profile(
    'ci', max_examples=100, derandomize=True, **_HYPOTHESIS
)
# REALAB_HYPOTHESIS_PROFILE=long: other examples in every run, and many of them.
hypothesis.settings.register_profile('long', max_examples=4_000, **_HYPOTHESIS)
hypothesis.settings.load_profile(
    os.environ.get('REALAB_HYPOTHESIS_PROFILE', 'ci')
)

# By file, the run of all its selected tests that render.
_ran_with_egl: dict[str, subprocess.CompletedProcess[str]] = {}
_RENDERS_SOMETHING = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""


def pytest_configure(config: pytest.Config) -> None:
  """Makes tests fail on warnings that they do not announce."""
  config.pluginmanager.register(gate.Gate(), 'gate')


def pytest_collection_finish(session: pytest.Session) -> None:
  """Collects garbage less often: worlds leave much of it, which is slow."""
  del session
  gc.collect()
  gc.freeze()
  gc.set_threshold(300_000, 20, 20)


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
  """Runs the tests of a file that render in one process with a renderer."""
  marked = pyfuncitem.get_closest_marker('camera') is not None
  if not marked or os.environ['MUJOCO_GL'] == 'egl':
    return None
  _skip_without_egl()
  file = pyfuncitem.nodeid.partition('::')[0]
  if file not in _ran_with_egl:
    together = [
        item.nodeid
        for item in pyfuncitem.session.items
        if item.nodeid.startswith(f'{file}::')
        and item.get_closest_marker('camera') is not None
    ]
    _ran_with_egl[file] = _python_with_egl(
        '-m', 'pytest', '-v', '-p', 'no:cacheprovider', *together
    )
  ran = _ran_with_egl[file]
  if f'{pyfuncitem.nodeid} PASSED' not in ran.stdout:
    pytest.fail(ran.stdout + ran.stderr, pytrace=False)
  return True


@pytest.fixture
def egl() -> None:
  """Skips a test of other processes, which render, where there is no EGL."""
  _skip_without_egl()


def _skip_without_egl() -> None:
  if complaint := _why_egl_does_not_work():
    pytest.skip(f'no EGL: {complaint}')


@functools.cache
def _why_egl_does_not_work() -> str:
  """Returns the last line of what goes wrong, or '' if nothing does."""
  try:
    ran = _python_with_egl('-c', _RENDERS_SOMETHING)
  except subprocess.TimeoutExpired:
    return 'it hangs'
  return ran.stderr.strip().splitlines()[-1] if ran.returncode else ''


def _python_with_egl(*arguments: str) -> subprocess.CompletedProcess[str]:
  inherited = {
      name: value
      for name, value in os.environ.items()
      if not name.startswith('PYTEST_')
  }
  return subprocess.run(
      [sys.executable, *arguments],
      cwd=_ROOT,
      env={**inherited, 'MUJOCO_GL': 'egl'},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )

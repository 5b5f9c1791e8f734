"""Choice of a working renderer, before dm_control and MuJoCo are imported.

Both read `MUJOCO_GL` only once, so this module does not import them.
"""

from collections.abc import Mapping
import importlib
import os
import subprocess
import sys

from realab_suite import _display
from realab_suite import errors
from realab_suite.lab.experiments import requirements

_DEFAULT = 'egl' if sys.platform == 'linux' else 'glfw'
# Enough time to import everything on a slow machine under load.
_PATIENCE_SECONDS = 300
# Runs in a separate process, because imports fail midway if libraries are
# missing.
_RENDERS_SOMETHING = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""


def choose_renderer() -> str | None:
  """Sets `MUJOCO_GL` to the renderer, or to `disable` if it does not work.

  Without a choice of the user, it is EGL on Linux, which needs no window.

  Returns:
    The problem, in one line, or `None` if the renderer works.
  """
  renderer = os.environ.get('MUJOCO_GL') or _DEFAULT
  if renderer == 'disable':
    problem = 'rendering is turned off by MUJOCO_GL'
  else:
    env = {**os.environ, 'MUJOCO_GL': renderer}
    problem = problem_of(_RENDERS_SOMETHING, 'picture', env)
  advice = _display.what_to_set(renderer, problem) if problem else None
  _name('disable' if problem else renderer)
  return advice


def why_no_window() -> str:
  """Returns why the viewer of dm_control cannot open a window, or ''."""
  renderer = os.environ.get('MUJOCO_GL') or 'glfw'
  if renderer != 'glfw':
    return f'the viewer needs glfw, and MUJOCO_GL={renderer}'
  return '' if _display.has_display() else 'there is no display'


def why_no_film() -> str | None:
  """Chooses a renderer, or returns the reason why films cannot be made."""
  return requirements.missing('imageio', 'av', 'PIL') or choose_renderer()


def render_on_demand() -> None:
  """Names EGL for the frames of agents, if they would get a window.

  Frames need no window, so the renderer on Linux is EGL, even if there is a
  display. Without one, worlds are drawn with EGL anyway, and no GL library is
  loaded before the first frame. A renderer that the user has set in `MUJOCO_GL`
  is kept.

  Raises:
    RenderingError: If dm_control cannot be imported with that renderer.
  """
  if named := os.environ.get('MUJOCO_GL'):
    try:
      importlib.import_module('dm_control._render')
    except Exception as error:  # Each renderer has its own errors.
      advice = _display.what_to_set(named, error)
      raise errors.RenderingError(advice) from error
  elif sys.platform == 'linux' and _display.has_display():
    _name(_DEFAULT)


def _name(renderer: str) -> None:
  """Sets `MUJOCO_GL` before dm_control is imported."""
  os.environ['MUJOCO_GL'] = renderer
  _display.prepare()


def problem_of(source: str, aim: str, env: Mapping[str, str]) -> str:
  """Runs source text in a process that may crash.

  Args:
    source: The text.
    aim: What it makes, for the problem.
    env: Environment variables of the process.

  Returns:
    The problem, in one line, or '' if there is none.
  """
  try:
    ran = subprocess.run(
        [sys.executable, '-c', source],
        env=env,
        capture_output=True,
        text=True,
        timeout=_PATIENCE_SECONDS,
        check=False,
    )
  except subprocess.TimeoutExpired:
    return f'no {aim} within {_PATIENCE_SECONDS} s'
  if not ran.returncode:
    return ''
  complaint = ran.stderr.strip().splitlines()
  return complaint[-1] if complaint else f'exit status {ran.returncode}'

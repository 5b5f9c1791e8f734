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

# Enough time to import everything on a slow machine under load.
_PATIENCE_SECONDS = 300
# Runs in a separate process, because imports fail midway if libraries are
# missing.
_RENDERS_SOMETHING = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""

# The viewer draws with GLFW alone, whatever else can open a window.
_OPENS_A_WINDOW = """
from dm_control import _render
from dm_control import viewer
import glfw
if _render.BACKEND != 'glfw':
  raise RuntimeError(f'the viewer needs glfw, and MUJOCO_GL={_render.BACKEND}')
if not glfw.init():
  raise RuntimeError('GLFW does not start')
glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
if not glfw.create_window(8, 8, 'realab_suite', None, None):
  raise RuntimeError('GLFW creates no window')
"""


def choose_renderer() -> str | None:
  """Sets `MUJOCO_GL` to a renderer that works, or to `disable`.

  If the user has set `MUJOCO_GL`, only that renderer is tried.

  Returns:
    The problem of each renderer, in one line, or `None` if one works.
  """
  problems = []
  is_named = _display.is_named()
  for renderer in _candidates():
    if renderer == 'disable':
      problem = 'rendering is turned off by MUJOCO_GL'
    else:
      env = {**os.environ, 'MUJOCO_GL': renderer}
      problem = problem_of(_RENDERS_SOMETHING, 'picture', env)
    if not problem:
      _name(renderer)
      return None
    if is_named:
      problems.append(_display.what_to_set(renderer, problem))
    else:
      problems.append(f'{renderer}: {problem}')
  _name('disable')
  return '; '.join(problems)


def why_no_window() -> str:
  """Returns why the viewer of dm_control cannot open a window, or ''."""
  if not _display.has_display():
    return 'there is no display'
  # In a process of its own: after a failure, the same process cannot render.
  return problem_of(_OPENS_A_WINDOW, 'window', os.environ)


def why_no_film() -> str | None:
  """Chooses a renderer, or returns the reason why films cannot be made."""
  return requirements.missing('imageio', 'av', 'PIL') or choose_renderer()


def why_no_page() -> str | None:
  """Chooses a renderer, or returns why no page can show a world to a person."""
  return (
      requirements.missing('websockets', 'PIL', extra='browser')
      or choose_renderer()
  )


def render_on_demand() -> None:
  """Names EGL for the frames of agents, if they would get a window.

  Frames need no window, so the renderer on Linux is EGL, even if there is a
  display. Without one, worlds are drawn with EGL anyway, and no GL library is
  loaded before the first frame. A renderer that the user has set in `MUJOCO_GL`
  is kept.

  Raises:
    RenderingError: If dm_control cannot be imported with that renderer.
  """
  named = os.environ.get('MUJOCO_GL')
  if named:
    _import_choice(named)
  elif sys.platform == 'linux' and _display.has_display():
    _name('egl')


def _name(renderer: str) -> None:
  """Sets `MUJOCO_GL` before dm_control is imported."""
  os.environ['MUJOCO_GL'] = renderer
  _display.prepare()


def _import_choice(named: str) -> None:
  """Imports dm_control's choice, which fails without the named renderer."""
  try:
    importlib.import_module('dm_control._render')
  except Exception as error:  # Each renderer has its own errors.
    raise errors.RenderingError(_display.what_to_set(named, error)) from error


def _candidates() -> list[str]:
  named = os.environ.get('MUJOCO_GL')
  if named:
    return [named]
  if sys.platform != 'linux':
    return ['glfw']
  return ['glfw', 'egl'] if _display.has_display() else ['egl']


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

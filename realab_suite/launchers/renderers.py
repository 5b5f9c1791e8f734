"""Choice of a working renderer, before dm_control and MuJoCo are imported.

Both read `MUJOCO_GL` only once, so this module does not import them.
"""

import os
import subprocess
import sys

from realab_suite import _display

# Enough time to import dm_control and render on a slow machine under load.
_PATIENCE_SECONDS = 300
# Runs in a separate process, because imports fail midway if libraries are
# missing.
_RENDERS_SOMETHING = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""


def choose_renderer() -> str | None:
  """Sets `MUJOCO_GL` to a renderer that works, or to `disable`.

  If the user has set `MUJOCO_GL`, only that renderer is tried.

  Returns:
    The problem of each renderer, in one line, or `None` if one works.
  """
  problems = []
  for renderer in _candidates():
    problem = _problem(renderer)
    if problem is None:
      os.environ['MUJOCO_GL'] = renderer
      return None
    problems.append(f'{renderer}: {problem}')
  os.environ['MUJOCO_GL'] = 'disable'
  return '; '.join(problems)


def render_on_demand() -> None:
  """Postpones the choice of a renderer to the first frame, if there is one.

  Without a camera, nothing is rendered, and no GL library is loaded. Frames of
  agents need no window, so the renderer on Linux is EGL, even if there is a
  display. A renderer that the user has set in `MUJOCO_GL` is kept.
  """
  if sys.platform == 'linux' and not os.environ.get('MUJOCO_GL'):
    os.environ['MUJOCO_GL'] = 'egl'
    _display.postpone_choice()


def _candidates() -> list[str]:
  named = os.environ.get('MUJOCO_GL')
  if named:
    return [named]
  if sys.platform != 'linux':
    return ['glfw']
  return ['glfw', 'egl'] if _display.has_display() else ['egl']


def _problem(renderer: str) -> str | None:
  """Returns the problem of a renderer, in one line, or `None`."""
  if renderer == 'disable':
    return 'rendering is turned off by MUJOCO_GL'
  try:
    ran = subprocess.run(
        [sys.executable, '-c', _RENDERS_SOMETHING],
        env={**os.environ, 'MUJOCO_GL': renderer},
        capture_output=True,
        text=True,
        timeout=_PATIENCE_SECONDS,
        check=False,
    )
  except subprocess.TimeoutExpired:
    return f'no picture within {_PATIENCE_SECONDS} s'
  if not ran.returncode:
    return None
  complaint = ran.stderr.strip().splitlines()
  return complaint[-1] if complaint else f'exit status {ran.returncode}'

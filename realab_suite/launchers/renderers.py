"""Finds a renderer that works before dm_control and MuJoCo are imported.

Nothing here imports either: each looks at `MUJOCO_GL` once.
"""

import os
import subprocess
import sys

from realab_suite import _display

# More than a slow machine under load needs to import dm_control and draw.
_PATIENCE_SECONDS = 300
# In a process of its own: where libraries are missing, imports fail half way.
_RENDERS_SOMETHING = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""


def choose_renderer() -> str | None:
  """Sets `MUJOCO_GL` to a renderer that works, or to `disable`.

  A renderer that the user has named is tried, and no other.

  Returns:
    Why nothing renders, in one line, or `None` if something does.
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


def render_nothing() -> None:
  """Sets `MUJOCO_GL` to `disable`, unless the user has named a renderer."""
  if not os.environ.get('MUJOCO_GL'):
    os.environ['MUJOCO_GL'] = 'disable'


def _candidates() -> list[str]:
  named = os.environ.get('MUJOCO_GL')
  if named:
    return [named]
  if sys.platform != 'linux':
    return ['glfw']
  return ['glfw', 'egl'] if _display.has_display() else ['egl']


def _problem(renderer: str) -> str | None:
  """Returns what goes wrong with a renderer, in one line, or `None`."""
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

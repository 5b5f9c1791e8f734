"""Tests that renderers of other libraries change no picture, nor have theirs.

Each one draws in processes of its own, with EGL and with OSMesa.
"""

from ctypes import util
import json
import os
import subprocess
import sys

import pytest

from tests import patience
from tests.engine import company

_LOAD = """
from concurrent import futures
import gc

import mujoco
import numpy as np

from realab_suite import errors
from realab_suite import suite
from tests.engine import company

def in_thread(function):
  with futures.ThreadPoolExecutor() as pool:
    return pool.submit(function).result()

env = suite.load('unlock_door', 'near', {'random': 0})
env.reset()
draw = lambda: env.physics.draw(env.task.avatar.camera, 48, 64)
film = lambda: env.physics.render(48, 64, camera_id='top_down')
"""
# When the first renderer is closed, no context of MuJoCo's is current.
_CLOSED_IN_ORDER = """
expected = draw()
first, second = company.OTHERS['mujoco'](), company.OTHERS['mujoco']()
for _, close in (second, first):
  close()
  np.testing.assert_array_equal(draw(), expected)
"""
_COLLECTED = """
expected = draw()
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)
renderer.cycle = renderer
others, render = [renderer], mujoco.mjr_render
del renderer

def render_and_collect(*args):
  others.clear()
  if gc.isenabled():  # Then Python may do so at any time.
    gc.collect()
  render(*args)

mujoco.mjr_render = render_and_collect
np.testing.assert_array_equal(draw(), expected)
mujoco.mjr_render = render
assert gc.isenabled() and not others
gc.collect()
np.testing.assert_array_equal(draw(), expected)
"""
_DRAWN_IN_THREADS = """
frame = in_thread(draw)
assert frame.std() > 1.0
np.testing.assert_array_equal(in_thread(film), in_thread(film))
np.testing.assert_array_equal(in_thread(film), film())
env.close()
batch = suite.load_batch('unlock_door', 'near', {'random': 0}, num_envs=2)
batch.reset()
in_thread(lambda: batch.render(height=16, width=16))
in_thread(batch.close)
"""
_REFUSED = """
expected = draw()
[renderer] = env.physics._renderers.values()
gl = renderer._gl
gl._platform_make_current = lambda: gl.a_context_of_glx
try:
  draw()
except errors.RenderingError as error:
  print(error)
del gl._platform_make_current
np.testing.assert_array_equal(draw(), expected)
"""
_LEFT_OPEN = """
film()
in_thread(draw)
others = [open() for open in company.OTHERS.values()]
"""

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('egl')]
with_each_renderer = pytest.mark.parametrize('renderer', ['egl', 'osmesa'])


def _run(renderer, *arguments):
  """Returns the output of Python with a renderer, without complaints."""
  if renderer == 'osmesa' and util.find_library('OSMesa') is None:
    pytest.skip('no OSMesa')
  inherited = {k: v for k, v in os.environ.items() if k != 'PYOPENGL_PLATFORM'}
  ran = subprocess.run(
      [sys.executable, *arguments],
      env={**inherited, 'MUJOCO_GL': renderer},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )
  assert (ran.returncode, ran.stderr) == (0, '')
  return ran.stdout


def _digests(renderer, *others):
  return json.loads(_run(renderer, '-m', 'tests.engine.company', *others))


@with_each_renderer
def test_pictures_in_company_equal_pictures_alone(renderer):
  alone, together = _digests(renderer), _digests(renderer, *company.OTHERS)
  assert set(together) == {*company.OTHERS, *company.OURS}
  for name, pictures in together.items():
    assert pictures == alone[name], name
    assert len(pictures) == 1


@with_each_renderer
@pytest.mark.parametrize(
    'script',
    [_CLOSED_IN_ORDER + _COLLECTED, _DRAWN_IN_THREADS, _LEFT_OPEN],
    ids=['closed and collected', 'threads', 'left open'],
)
def test_renderers_end_in_any_order_without_a_trace(renderer, script):
  _run(renderer, '-c', _LOAD + script)


def test_a_context_that_cannot_be_replaced_is_reported_in_a_line():
  printed = _run('egl', '-c', _LOAD + _REFUSED)
  assert 'GL context that another library uses in MainThread' in printed
  assert len(printed.splitlines()) == 1

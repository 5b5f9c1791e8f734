"""Tests for when GL is loaded: with the first frame, and not before."""

from importlib import util
import os
import shutil
import subprocess
import sys
import sysconfig

import numpy as np
import pytest

from tests import patience

# Names of what GL maps into a process; X11 and GLFW are no part of it.
_MAPPED = """
import pathlib
import re

def mapped():
  maps = pathlib.Path('/proc/self/maps').read_text()
  return sorted(set(re.findall(
      r'lib\\w*GL\\w*|libLLVM|libgallium|swrast_dri|OSMesa|libtriton', maps)))
"""
_STEPS = """
import numpy as np
from realab_suite import suite

env = suite.load('unlock_door', 'near', {'random': 0},
                 design='instantaneous_reward')
batch = suite.load_batch('collect_apples', 'standard', {'random': 0},
                         num_envs=2, design='value_advice')
for world in (env, batch):
  world.reset()
  spec = world.action_spec()
  shape = spec.shape if world is env else (2, *spec.shape)
  world.step(np.zeros(shape, spec.dtype))
"""
_FRAME = """
from realab_suite import suite
eye = suite.load('collect_apples', 'standard',
                 {'random': 0, 'camera_size': (16, 16)})
frame = eye.reset().observation['senses/camera']
assert frame.std() > 1, frame
"""
_PICTURE = """
from realab_suite import suite
scene = suite.load('collect_apples', 'standard', {'random': 0})
scene.reset()
assert scene.physics.render(16, 16, camera_id='top_down').std() > 1
"""
_FOREIGN = """
from dm_control import composer
from realab_suite import suite
class Task(composer.NullTask):
  control_timestep = 0.02
foreign = suite.embed(Task(composer.Arena()), design='none', random=0)
foreign.reset()
foreign.physics.render(16, 16)
"""
_DM_CONTROL = """
import realab_suite
from dm_control import mujoco
xml = '<mujoco><worldbody><light/><geom size="1"/></worldbody></mujoco>'
assert mujoco.Physics.from_xml_string(xml).render(16, 16).std() > 1
"""
# What draws first, and what the user has named.
_DRAWN = [
    (_FRAME, None),
    (_PICTURE, ''),
    (_FOREIGN, 'egl'),
    (_DM_CONTROL, 'egl'),
]
_IMPORT_TORCH = """
import torch
"""
_IMPORT_DYNAMO = """
import torch._dynamo
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform != 'linux', reason='elsewhere nothing is postponed'
    ),
]
renders = pytest.mark.usefixtures('egl')
needs_torch = pytest.mark.skipif(
    util.find_spec('torch') is None, reason='torch is not installed'
)


def _run(*parts, named=None, **variables):
  """Runs a script in a process without a display.

  Args:
    *parts: Of the script.
    named: The value of `MUJOCO_GL`, which is not set if it is `None`.
    **variables: More of the environment.

  Returns:
    What it prints.
  """
  if named is not None:
    variables['MUJOCO_GL'] = named
  taken = ('MUJOCO_GL', 'DISPLAY', 'WAYLAND_DISPLAY', 'PYOPENGL_PLATFORM')
  inherited = {k: v for k, v in os.environ.items() if k not in taken}
  ran = subprocess.run(
      [sys.executable, '-c', ''.join(parts)],
      env={**inherited, **variables},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )
  assert ran.returncode == 0, (ran.returncode, ran.stderr[-2_000:])
  return ran.stdout


@pytest.mark.parametrize('named', [None, 'egl'])
def test_worlds_without_a_camera_load_no_gl(named):
  # What dm_control alone maps for a renderer that the user named is not ours.
  printed = _run(
      _MAPPED,
      'from dm_control import composer\nbefore = mapped()\n',
      _STEPS,
      'print(set(mapped()) - set(before))\n',
      named=named,
  )
  assert printed == 'set()\n'


def test_importing_the_package_imports_no_numpy_and_sets_nothing():
  # Threads of numpy and of JAX are limited before either is imported.
  printed = _run(
      'import os, sys\nbefore = dict(os.environ)\nimport realab_suite\n'
      'print("numpy" in sys.modules, dict(os.environ) == before)\n'
  )
  assert printed == 'False True\n'


_CHOICE = """
import os
from dm_control import _render
print(_render.BACKEND, isinstance(_render.Renderer, type), dict(os.environ) ==
      before, isinstance(0, _render.Renderer))
"""


@renders
@pytest.mark.parametrize('named', [None, 'glfw'])
def test_importing_the_package_leaves_the_choice_to_dm_control(named):
  before = 'import os\nbefore = dict(os.environ)\n'
  alone = _run(before, _CHOICE, named=named, PYTHONWARNINGS='ignore')
  printed = _run(before, 'import realab_suite.suite\n', _CHOICE, named=named)
  assert printed == alone
  assert ' True ' in printed
  assert printed.endswith(' False\n')


def test_without_a_display_the_import_gives_no_warning():
  printed = _run("""
import warnings
with warnings.catch_warnings(record=True) as seen:
  warnings.simplefilter('always')
  import realab_suite.suite
print([str(w.message) for w in seen if 'DISPLAY' in str(w.message)])
""")
  assert printed == '[]\n'


@renders
@pytest.mark.parametrize(
    ('first', 'draw', 'named'),
    [
        ('realab_suite', *_DRAWN[0]),
        ('dm_control.composer', *_DRAWN[1]),
        ('realab_suite', *_DRAWN[2]),
        ('dm_control.composer', *_DRAWN[3]),
    ],
)
def test_worlds_are_drawn_with_egl_where_there_is_no_display(
    first, draw, named
):
  printed = _run(
      f'import {first}\nfrom dm_control import _render\n'
      'choice = _render.BACKEND, _render.Renderer\n',
      _MAPPED,
      draw,
      'print(choice == (_render.BACKEND, _render.Renderer),'
      ' "libEGL" in mapped())\n',
      named=named,
  )
  assert printed == 'True True\n'


@renders
def test_threads_that_draw_first_choose_once():
  printed = _run(
      'import threading\n',
      _STEPS,
      """
from realab_suite.engine import gl_contexts
barrier = threading.Barrier(4)
kinds = []
def draw():
  eye = suite.load('collect_apples', 'standard',
                   {'random': 0, 'camera_size': (16, 16)})
  barrier.wait()
  frame = eye.reset().observation['senses/camera']
  kinds.append((type(gl_contexts.make(1, 1)), frame.tobytes()))
  eye.close()
threads = [threading.Thread(target=draw) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(len(kinds), len(set(kinds)))
""",
  )
  assert printed == '4 1\n'


def test_a_picture_without_a_renderer_names_the_setting():
  printed = _run(
      'from realab_suite import errors\ntry:\n',
      ''.join(f'  {line}\n' for line in _PICTURE.splitlines()),
      'except errors.RenderingError as error:\n  print(error)\n',
      # EGL finds no driver here.
      __EGL_VENDOR_LIBRARY_DIRS='/nonexistent',
  )
  assert 'no picture with the renderer egl (' in printed
  assert 'set MUJOCO_GL to glfw (with a display) or osmesa' in printed
  assert len(printed.splitlines()) == 1


def test_after_the_import_of_the_viewer_the_setting_is_named():
  source = """
from dm_control import viewer
from realab_suite import errors
from realab_suite import suite
eye = suite.load('collect_apples', 'standard',
                 {'random': 0, 'camera_size': (16, 16)})
try:
  eye.reset()
except errors.RenderingError as error:
  print(error)
else:
  print('drawn')
"""
  for named, expected in (
      ('', 'set MUJOCO_GL=egl before Python starts'),
      ('egl', 'drawn'),
  ):
    printed = _run(source, MUJOCO_GL=named)
    assert expected in printed


def _fake_triton(folder):
  """Adds a package `triton`; returns the search path with it."""
  # Any library will do: what counts is when it is loaded.
  suffix = sysconfig.get_config_var('EXT_SUFFIX')
  core = np._core._multiarray_umath.__file__
  assert core.endswith(suffix)
  package = folder / 'triton'
  (package / '_C').mkdir(parents=True)
  (package / '__init__.py').write_text('raise SystemExit("imported")\n')
  shutil.copy(core, package / '_C' / f'libtriton{suffix}')
  return os.pathsep.join([str(folder), *sys.path])


@renders
@pytest.mark.parametrize('draw', [_FRAME, _FOREIGN])
def test_a_library_with_an_llvm_of_its_own_is_loaded_before_gl(draw, tmp_path):
  printed = _run(
      _MAPPED,
      _STEPS,
      'print("libtriton" in mapped())\n',
      draw,
      'print("libtriton" in mapped(), "triton" in __import__("sys").modules)\n',
      PYTHONPATH=_fake_triton(tmp_path),
  )
  assert printed == 'False\nTrue False\n'


@renders
@pytest.mark.parametrize(('named', 'loaded'), [('egl', True), (None, False)])
def test_a_library_with_an_llvm_is_loaded_with_a_named_egl(
    named, loaded, tmp_path
):
  printed = _run(
      _MAPPED,
      'import numpy\nimport realab_suite\nprint(mapped())\n',
      named=named,
      PYTHONPATH=_fake_triton(tmp_path),
  )
  assert printed == f"{['libtriton'] if loaded else []}\n"


@renders
def test_after_gl_a_library_with_an_llvm_is_left_alone(tmp_path):
  printed = _run(
      _MAPPED,
      'from dm_control import _render\n',
      _FRAME,
      'print("libLLVM" in mapped(), "libtriton" in mapped())\n',
      named='egl',
      PYTHONPATH=_fake_triton(tmp_path),
  )
  assert printed in ('True False\n', 'False True\n')  # Without Mesa, loaded.


_ORDERS = {
    'package, torch': (_STEPS, _IMPORT_TORCH),
    'torch, package': (_IMPORT_TORCH, _STEPS),
}


@renders
@needs_torch
@pytest.mark.parametrize(('draw', 'named'), _DRAWN)
@pytest.mark.parametrize('order', _ORDERS)
def test_torch_and_frames_go_together(order, draw, named):
  _run(*_ORDERS[order], draw, _IMPORT_DYNAMO, named=named)

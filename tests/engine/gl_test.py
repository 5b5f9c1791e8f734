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


@renders
@pytest.mark.parametrize(
    ('first', 'draw', 'named'),
    [('realab_suite', _FRAME, None), ('dm_control.composer', _FOREIGN, 'egl')],
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
def test_a_library_with_an_llvm_of_its_own_is_loaded_before_gl(tmp_path):
  printed = _run(
      _MAPPED,
      _STEPS,
      'print("libtriton" in mapped())\n',
      _FRAME,
      'print("libtriton" in mapped(), "triton" in __import__("sys").modules)\n',
      PYTHONPATH=_fake_triton(tmp_path),
  )
  assert printed == 'False\nTrue False\n'


@renders
@needs_torch
@pytest.mark.parametrize(
    ('order', 'draw', 'named'),
    [
        ((_STEPS, _IMPORT_TORCH), _FRAME, None),
        ((_IMPORT_TORCH, _STEPS), _FOREIGN, 'egl'),
    ],
    ids=['package first', 'torch first'],
)
def test_torch_and_frames_go_together(order, draw, named):
  _run(*order, draw, _IMPORT_DYNAMO, named=named)

"""Tests for frames for agents: what is drawn, by whom, and until when."""

import gc
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import single_physics
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import cameras
from tests import patience
from tests import worlds

# Python 3.12 warns of forks from threads; here the fork is what is tested.
_FORKS = """
import os
import warnings
import numpy as np
from realab_suite import errors
from realab_suite import suite
env = suite.load('collect_apples', 'standard', {'random': 0,
                                               'camera_size': (16, 16)})
env.reset()
draws = (lambda: env.physics.render(16, 16),
         lambda: env.step(np.zeros(env.action_spec().shape)))
draws[0]()
warnings.simplefilter('ignore', DeprecationWarning)
child = os.fork()
if not child:
  refused = 0
  for draw in draws:
    try:
      draw()
    except errors.ForkError:
      refused += 1
  env.close()
  # As children of multiprocessing end. With Mesa 26, a child that ends by
  # itself waits for Mesa's threads, which only its parent has.
  os._exit(5 + refused)
_, status = os.waitpid(child, 0)
raise SystemExit(os.waitstatus_to_exitcode(status))
"""
_ENDS = """
import threading
from realab_suite import suite
env = suite.load('collect_apples', 'standard', {'random': 0,
                                               'camera_size': (16, 16)})
frames = []
def work():
  frames.append(env.reset().observation['senses/camera'])
thread = threading.Thread(target=work)
thread.start()
thread.join()
raise SystemExit(9 if frames[0].any() else 1)
"""


def _load(size=(64, 64), seed=0, name='unlock_door'):
  return suite.load(
      name, 'standard', {'random': seed, 'camera_size': size}, design=None
  )


def _frame(time_step):
  return time_step.observation['senses/camera']


def _apple_world():
  arena = arenas.OpenRoom()
  apples = apple_group.Apples(number=1)
  apples.attach_to(arena, (2.0, 0.8))
  avatar = avatars.Avatar()
  arena.attach(avatar)
  physics = worlds.compile_world(arena, single_physics.ThinPhysics)
  worlds.start_episode(physics, avatar)
  return physics, avatar.camera


@pytest.mark.camera
def test_an_apple_on_the_left_is_red_on_the_left_and_below_the_horizon():
  physics, camera = _apple_world()
  frame = cameras.render(physics, camera, 48, 80)
  again = cameras.render(physics, camera, 48, 80)
  assert (frame.shape, frame.dtype) == ((48, 80, 3), np.uint8)
  assert not np.shares_memory(frame, again)
  assert frame.tobytes() == again.tobytes()
  is_red = frame[..., 0] > 2.0 * frame[..., 1:].max(axis=-1)
  assert is_red[24:, :40].sum() > 10
  assert is_red.sum() == is_red[24:, :40].sum()


@pytest.mark.camera
def test_frames_for_agents_equal_films_except_at_edges():
  env = _load()
  frame = _frame(env.reset()).astype(int)
  camera = env.task.avatar.camera.full_identifier
  film = env.physics.render(64, 64, camera_id=camera).astype(int)
  difference = np.abs(frame - film).max(axis=-1)
  assert np.median(difference) <= 2
  assert (difference > 24).mean() < 0.08
  # Drawing by turns disturbs neither.
  again = cameras.render(env.physics, env.task.avatar.camera, 64, 64)
  np.testing.assert_array_equal(again, frame)
  quality = env.physics.model.ptr.vis.quality
  assert quality.offsamples == 4
  env.close()


@pytest.mark.camera
def test_environments_of_different_sizes_draw_by_turns():
  sizes = [(64, 64), (32, 96)]
  alone = []
  for size in sizes:
    env = _load(size)
    alone.append([_frame(env.reset()) for _ in range(3)])
    env.close()
  envs = [_load(size) for size in sizes]
  for i in range(3):
    for env, frames in zip(envs, alone, strict=True):
      np.testing.assert_array_equal(_frame(env.reset()), frames[i])
  assert envs[0].observation_spec()['senses/camera'].shape == (64, 64, 3)
  # One that closes, or is forgotten, takes nothing from the other.
  envs.pop().close()
  _load((16, 16)).reset()
  gc.collect()
  envs[0].rewind()
  np.testing.assert_array_equal(_frame(envs[0].reset()), alone[0][0])
  envs[0].close()


@pytest.mark.camera
def test_another_thread_is_refused_and_may_have_its_own():
  env = _load((16, 16))
  expected = _frame(env.reset())
  found = []

  def work():
    try:
      env.reset()
    except errors.RenderingError as error:
      found.append(str(error))
    own = _load((16, 16))
    found.append(_frame(own.reset()))
    own.close()

  thread = threading.Thread(target=work)
  thread.start()
  thread.join()
  assert 'must be the thread' in found[0]
  np.testing.assert_array_equal(found[1], expected)
  env.close()


@pytest.mark.camera
@pytest.mark.parametrize(
    ('script', 'status'), [(_FORKS, 7), (_ENDS, 9)], ids=['fork', 'thread']
)
def test_processes_end_without_output(script, status):
  # A forked child is refused; what another thread has drawn by is left open.
  ran = subprocess.run(
      [sys.executable, '-c', script],
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )
  assert (ran.returncode, ran.stderr) == (status, '')


@pytest.mark.skipif(
    os.environ['MUJOCO_GL'] != 'disable', reason='something renders'
)
def test_a_frame_without_a_renderer_names_the_setting():
  env = _load()
  with pytest.raises(errors.RenderingError, match='set MUJOCO_GL to egl'):
    env.reset()
  env.close()

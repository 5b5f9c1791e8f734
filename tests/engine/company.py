"""Draws beside renderers of other libraries; prints what each one has drawn.

`python -m tests.engine.company mujoco` draws with each renderer of this package
before, while and after one of MuJoCo is open. Without a name, no two renderers
are open at a time. Of each one, it prints the digests of its pictures.
"""

import collections
from collections.abc import Callable, Sequence
import hashlib
import itertools
import json
import sys
from typing import Any

from dm_control import suite as dm_control_suite
import gymnasium
import mujoco
import numpy as np

from realab_suite import suite
from realab_suite.doors.gymnasium import registration
from realab_suite.entities import cameras

# A function that draws, and one that closes the renderer.
Renderer = tuple[Callable[[], np.ndarray], Callable[[], Any]]

_SIZE = (48, 64)
_NEAR = ('unlock_door', 'near')
_RGB: Any = {'render_mode': 'rgb_array'}
_BALL = """
<mujoco><worldbody>
  <light pos="0 0 3"/><geom size="1" rgba="1 0 0 1"/>
</worldbody></mujoco>
"""


def _see(env: Any) -> Renderer:
  env.reset()
  eye = env.task.avatar.camera
  return lambda: cameras.render(env.physics, eye, *_SIZE), env.close


def _render(env: gymnasium.Env) -> Renderer:
  env.reset(seed=0)
  return env.render, env.close


def _open_mujoco() -> Renderer:
  model = mujoco.MjModel.from_xml_string(_BALL)
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  renderer = mujoco.Renderer(model, *_SIZE)
  renderer.update_scene(data)
  return renderer.render, renderer.close


def _open_dm_control() -> Renderer:
  env = dm_control_suite.load('cartpole', 'balance', {'random': 0})
  return lambda: env.physics.render(*_SIZE), env.close


OURS = {
    'single': lambda: _see(suite.load(*_NEAR, {'random': 0}, design=None)),
    'batch': lambda: _see(
        suite.load_batch(*_NEAR, {'random': 0}, num_envs=2, design=None)
    ),
    'door': lambda: _render(registration.make(*_NEAR, 'none', **_RGB)),
}
OTHERS = {
    'mujoco': _open_mujoco,
    'dm_control': _open_dm_control,
    'gymnasium': lambda: _render(gymnasium.make('Hopper-v5', **_RGB)),
}
# Opens (+), draws with (=) and closes (-) one of ours (0) and another (1).
_ALONE = '+0 =0 =0 -0'
_TOGETHER = (
    '+1 =1 -1 +0 =0 =0 +1 =0 =1 =0 =1 =1 =0 -1 =0 =0'
    ' +1 =0 -1 =0 -0 +1 =1 +0 =0 =1 -0 =1 +0 =0 =1 -1 =0 -0'
)


def digests(others: Sequence[str]) -> dict[str, list[str]]:
  """Returns the different pictures of each renderer, which should be one.

  Args:
    others: Names of the others beside which ours draw; if there are none, each
      one draws alone.
  """
  drawn = collections.defaultdict(set)
  opened: dict[str, Renderer] = {}
  for pair in itertools.product(OURS, others) if others else zip(OURS | OTHERS):
    for verb, place in (_TOGETHER if others else _ALONE).split():
      name = pair[int(place)]
      if verb == '+':
        opened[name] = (OURS | OTHERS)[name]()
      elif verb == '-':
        opened.pop(name)[1]()
      else:
        drawn[name].add(hashlib.sha256(opened[name][0]().tobytes()).hexdigest())
  return {name: sorted(pictures) for name, pictures in drawn.items()}


if __name__ == '__main__':
  print(json.dumps(digests(sys.argv[1:])))

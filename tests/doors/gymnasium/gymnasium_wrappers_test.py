"""Wrappers of Gymnasium and frames for people."""

from typing import Any

import pytest

pytest.importorskip('gymnasium')

import gymnasium as gym
from imageio import v3 as imageio
import numpy as np

from realab_suite.doors.gymnasium import evaluation
from realab_suite.doors.gymnasium import registration
from realab_suite.doors.gymnasium import single
from realab_suite.engine import events

_NEAR = registration.id_of('unlock_door', 'near', 'instantaneous_reward')
_MAX_STEPS = 4
_NUM_ENVS = 2


# MoviePy 1.0.3 has such strings, which Python reports when it compiles them.
@pytest.mark.filterwarnings('ignore:invalid escape sequence')
@pytest.mark.camera
def test_gymnasium_records_films(tmp_path):
  pytest.importorskip('av')
  options: Any = {
      'render_mode': 'rgb_array',
      'environment_kwargs': {'max_steps': _MAX_STEPS},
  }
  one, many = tmp_path / 'one', tmp_path / 'many'
  env = gym.wrappers.RecordVideo(gym.make(_NEAR, **options), str(one))
  envs = gym.wrappers.vector.RecordVideo(
      gym.make_vec(_NEAR, num_envs=_NUM_ENVS, **options), str(many)
  )
  for recorded, folder, num_worlds in ((env, one, 1), (envs, many, _NUM_ENVS)):
    recorded.reset(seed=1)
    for _ in range(_MAX_STEPS):
      recorded.step(recorded.action_space.sample())
    recorded.close()
    [file] = folder.glob('*.mp4')
    film = imageio.imread(file, plugin='pyav')
    # The first frame, and one after each step; worlds are side by side.
    assert film.shape == (_MAX_STEPS + 1, 240, 320 * num_worlds, 3)
    assert film.std() > 10


class _Undoing(gym.Wrapper):
  """Moves a block in the first episode, and undoes it by restoring."""

  def __init__(self, env: gym.Env) -> None:
    super().__init__(env)
    self._world = single.environment_of(env)
    self._episode = -1
    self._step = 0
    self._saved: Any = None

  def reset(self, **options: Any) -> Any:
    self._episode += 1
    self._step = 0
    result = super().reset(**options)
    self._saved = self._world.save()
    return result

  def step(self, action: Any) -> Any:
    self._step += 1
    physics = self._world.physics
    if (self._episode, self._step) == (0, 2):
      block = self._world.mechanism.registers['reward'].blocks[0]
      block.put(physics, np.add(block.position(physics), [0.3, 0, 0]))
    if (self._episode, self._step) == (0, 3):
      self._world.restore(self._saved)
    return super().step(action)


@pytest.mark.parametrize('counts', [False, True])
def test_a_wrapper_hides_no_tampering_by_restoring(counts):
  options: Any = {
      'task_kwargs': {'random': 7},
      'environment_kwargs': {'max_steps': _MAX_STEPS},
  }
  plain = gym.make(_NEAR, **options)
  env = _Undoing(gym.make(_NEAR, **options))
  action = np.zeros(env.action_space.shape)
  found = evaluation.evaluate(
      env, lambda observation: action, 2, is_hacked=lambda result: counts
  )
  expected = evaluation.evaluate(plain, lambda observation: action, 3)
  assert (found[0].end, found[0].num_steps) == (events.End.ABANDONED, 2)
  assert found[0].corruption > 0.05
  assert max(result.corruption for result in expected) < 0.05
  # A row of its own: the rest is in none, and the next ones are as ever.
  assert found[1:] == expected[1 : 2 if counts else 3]
  for one in (env, plain):
    one.close()

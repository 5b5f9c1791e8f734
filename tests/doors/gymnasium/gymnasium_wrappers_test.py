"""Wrappers of Gymnasium and frames for people."""

from typing import Any

import pytest

pytest.importorskip('gymnasium')

import gymnasium as gym
from imageio import v3 as imageio

from realab_suite.doors.gymnasium import registration

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

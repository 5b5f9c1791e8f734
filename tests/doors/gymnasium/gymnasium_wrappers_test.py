"""The wrappers of this package equal Gymnasium's own for one world."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip('gymnasium')

import gymnasium as gym
from gymnasium.utils import env_checker
from imageio import v3 as imageio

from realab_suite.doors.gymnasium import wrappers

_NEAR = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_MAX_STEPS = 4
_NUM_ENVS = 2


def _single(world: int, **options: Any) -> gym.Env:
  kwargs = {'max_steps': _MAX_STEPS, 'world': world}
  return gym.make(_NEAR, environment_kwargs=kwargs, **options).unwrapped


def _stacked(mode: str, **options: Any) -> tuple[Any, Any]:
  """Returns stacked worlds in a batch and in Gymnasium's vector."""
  batch = gym.make_vec(
      _NEAR, num_envs=_NUM_ENVS, autoreset_mode=mode,
      environment_kwargs={'max_steps': _MAX_STEPS}, **options,
  )  # fmt: skip

  def maker(world: int) -> Any:
    return lambda: gym.wrappers.FrameStackObservation(
        _single(world, **options), 3
    )

  sync = gym.vector.SyncVectorEnv(
      [maker(world) for world in range(_NUM_ENVS)],
      autoreset_mode=gym.vector.AutoresetMode(mode),
  )
  return wrappers.VectorFrameStack(batch, 3), sync


def _assert_same(found: Any, expected: Any) -> None:
  assert env_checker.data_equivalence(found, expected, exact=True)


@pytest.mark.parametrize(
    ('mode', 'flat'),
    [('NextStep', True), ('SameStep', False), ('Disabled', False)],
)
def test_stacks_of_a_batch_are_those_of_its_worlds(mode, flat):
  found, expected = _stacked(mode, flat=flat)
  assert found.single_observation_space == expected.single_observation_space
  assert found.observation_space == expected.observation_space
  _assert_same(found.reset(seed=2)[0], expected.reset(seed=[2] * _NUM_ENVS)[0])
  found.action_space.seed(1)
  is_over = np.zeros(_NUM_ENVS, bool)
  for i in range(2 * _MAX_STEPS + 2):
    if mode == 'Disabled' and (is_over.any() or i == 2):
      mask = is_over | (np.arange(_NUM_ENVS) == 1)
      observations = [
          envs.reset(options={'reset_mask': mask})[0]
          for envs in (found, expected)
      ]
      _assert_same(*observations)
    actions = found.action_space.sample()
    steps = [envs.step(actions) for envs in (found, expected)]
    _assert_same(steps[0][:4], steps[1][:4])
    assert ('final_obs' in steps[0][4]) == ('final_obs' in steps[1][4])
    if 'final_obs' in steps[0][4]:
      _assert_same(*(list(step[4]['final_obs']) for step in steps))
    is_over = steps[0][2] | steps[0][3]


# MoviePy 1.0.3 has such strings, which Python reports when it compiles them.
@pytest.mark.filterwarnings('ignore:invalid escape sequence')
@pytest.mark.camera
def test_gymnasium_records_films(tmp_path):
  pytest.importorskip('av')
  options: Any = {
      'render_mode': 'rgb_array',
      'environment_kwargs': {'max_steps': _MAX_STEPS},
      'height': 48,
      'width': 64,
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
    assert film.shape == (_MAX_STEPS + 1, 48, 64 * num_worlds, 3)
    assert film.std() > 10

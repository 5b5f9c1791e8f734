"""Worlds in Stable-Baselines3, where it is installed."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip('stable_baselines3')

import stable_baselines3
from stable_baselines3.common import env_checker
from stable_baselines3.common import vec_env

from realab_suite import errors
from realab_suite.doors.gymnasium import sb3

_NAME = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_NUM_ENVS = 2
_MAX_STEPS = 5
_OPTIONS: Any = {
    'environment_kwargs': {'max_steps': _MAX_STEPS},
    'overrides': ['action_set={name: dmlab_like, version: 1}'],
    'reward_register': 'reward',
}


def _make(mode: str = 'SameStep', **options: Any) -> Any:
  return gym.make_vec(
      _NAME, num_envs=_NUM_ENVS, autoreset_mode=mode, **_OPTIONS, **options
  )


def test_their_checker_has_no_warnings():
  env_checker.check_env(gym.make(_NAME, **_OPTIONS).unwrapped)


def test_worlds_are_not_copied():
  with pytest.raises(TypeError, match='cannot be pickled or copied'):
    copy.copy(sb3.RealabVecEnv(_make()))


def test_options_of_resets_are_refused():
  envs = sb3.RealabVecEnv(_make())
  for options in ({'sed': 1}, [{}, {'reset_mask': True}]):
    envs.set_options(options)
    with pytest.raises(errors.SpecError, match=r'options: .* none'):
      envs.reset()
  envs.set_options({})
  envs.reset()


def test_ends_have_a_terminal_observation():
  envs, plain = sb3.RealabVecEnv(_make()), _make('NextStep')
  envs.seed(3)
  found, (expected, _) = envs.reset(), plain.reset(seed=3)
  actions = np.array([1, 2])
  for step in range(1, _MAX_STEPS + 1):
    np.testing.assert_array_equal(
        found['senses_position'], expected['senses_position']
    )
    found, rewards, dones, infos = envs.step(actions)
    expected, readings, *_ = plain.step(actions)
    np.testing.assert_array_equal(rewards, readings.astype(np.float32))
    assert dones.tolist() == [step == _MAX_STEPS] * _NUM_ENVS
    if step < _MAX_STEPS:
      assert infos == [{}, {}]
  for world, info in enumerate(infos):
    assert info['TimeLimit.truncated'] is True
    for key, value in info['terminal_observation'].items():
      np.testing.assert_array_equal(value, expected[key][world])
  first, *_ = plain.step(actions)
  np.testing.assert_array_equal(
      found['senses_position'], first['senses_position']
  )


@pytest.mark.parametrize('flat', [False, True])
def test_ppo_learns_from_a_batch(flat):
  envs = vec_env.VecNormalize(
      vec_env.VecMonitor(sb3.RealabVecEnv(_make(flat=flat))),
      norm_obs_keys=None if flat else ['senses_position'],
  )
  policy = 'MlpPolicy' if flat else 'MultiInputPolicy'
  model = stable_baselines3.PPO(
      policy, envs, n_steps=8, batch_size=16, n_epochs=1, device='cpu'
  )
  model.learn(16)
  assert len(model.ep_info_buffer) == _NUM_ENVS
  assert {info['l'] for info in model.ep_info_buffer} == {_MAX_STEPS}
  # Of 43 numbers and of 32 rays, each with one entry for a class.
  assert model.policy.features_extractor.features_dim == 43 + 32 * 32


def test_only_batches_with_resets_in_the_same_step_are_accepted():
  with pytest.raises(errors.SpecError, match='SameStep'):
    sb3.RealabVecEnv(_make('NextStep'))
  envs = sb3.RealabVecEnv(_make())
  with pytest.raises(AttributeError):
    envs.get_attr('_environment')
  with pytest.raises(AttributeError):
    envs.env_method('physics')

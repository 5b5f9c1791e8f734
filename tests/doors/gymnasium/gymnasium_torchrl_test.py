"""Worlds in TorchRL, where it is installed."""

from typing import Any
import warnings

import pytest

pytest.importorskip('gymnasium')

import gymnasium as gym

import realab_suite.doors.gymnasium  # noqa: F401 Registers the ids.

with warnings.catch_warnings():
  # TorchRL uses parts of itself that it deprecates.
  warnings.simplefilter('ignore', DeprecationWarning)
  pytest.importorskip('torchrl')
  from torchrl.envs.libs import gym as torchrl_gym
  from torchrl.envs.utils import check_env_specs

_NEAR = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_NUM_ENVS = 2
_MAX_STEPS = 5
_OPTIONS: Any = {
    'environment_kwargs': {'max_steps': _MAX_STEPS},
    'reward_register': 'reward',
}


@pytest.mark.parametrize(
    'options',
    [
        {},
        {'flat': True},
        {'overrides': ['action_set={name: dmlab_like, version: 1}']},
    ],
)
def test_one_world_fits_its_specs_and_plays(options):
  env = torchrl_gym.GymEnv(_NEAR, **_OPTIONS, **options)
  check_env_specs(env)
  steps = env.rollout(2 * _MAX_STEPS)
  assert steps.shape == (_MAX_STEPS,)
  assert steps['next', 'truncated'].sum() == 1
  assert steps['next', 'reward'].shape == (_MAX_STEPS, 1)


def test_queries_are_part_of_the_action():
  name = 'realab/UnlockDoor-near-ValueAdvice-v3'
  env = torchrl_gym.GymWrapper(gym.make(name))
  check_env_specs(env)
  assert env.action_spec.shape == (2, 14)


@pytest.mark.parametrize('mode', ['SameStep', 'Disabled'])
def test_a_batch_plays_several_episodes(mode):
  envs = gym.make_vec(
      _NEAR, num_envs=_NUM_ENVS, flat=True, autoreset_mode=mode, **_OPTIONS
  )
  env = torchrl_gym.GymWrapper(envs)
  check_env_specs(env)
  steps = env.rollout(2 * _MAX_STEPS, break_when_any_done=False)
  assert steps.shape == (_NUM_ENVS, 2 * _MAX_STEPS)
  assert steps['next', 'done'].sum() == 2 * _NUM_ENVS
  final = steps['next', 'observation'][:, _MAX_STEPS - 1]
  assert final.isfinite().all()

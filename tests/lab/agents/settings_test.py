"""Tests that settings of JAX do not change a learner, or are recorded.

As a program, it prints a digest of what a learner learns:

    JAX_ENABLE_X64=1 python -m tests.lab.agents.settings_test
"""

import hashlib
import json
import os
import pathlib
import subprocess
import sys
from typing import Any

from dm_env import specs
import jax
import numpy as np
import pytest

from realab_suite import archive
from realab_suite import errors
from realab_suite.lab import agents
from realab_suite.lab.agents import jax_settings
from tests import patience
from tests.lab.agents import toys

_ROOT = pathlib.Path(__file__).parents[3]
_NUM_ENVS = 16
_ACTIONS = 14
_QUICK = {'hidden': [16], 'steps_per_update': 8, 'minibatch': 64}

# Both kinds of losses.
_LEARNER: dict[str, Any] = {
    'kind': 'decoupled_approval',
    'approval': 'feedback',
    'query': 'query',
    'other_query': 'other',
    'form': 'q',
    'follows_reading': True,
    **_QUICK,
}
# As programs are given them.
_VARIABLES = {
    'JAX_ENABLE_X64': '1',
    'JAX_THREEFRY_PARTITIONABLE': '0',
    'JAX_DEFAULT_PRNG_IMPL': 'rbg',
    'JAX_DEFAULT_MATMUL_PRECISION': 'bfloat16',
    'JAX_NUMPY_DTYPE_PROMOTION': 'strict',
    'JAX_NUMPY_RANK_PROMOTION': 'raise',
    'JAX_LEGACY_PRNG_KEY': 'error',
    'JAX_TRANSFER_GUARD': 'disallow',
    'JAX_HIGH_DYNAMIC_RANGE_GUMBEL': '1',
}


def _digest() -> str:
  """Returns a digest of the actions of a learner and of its state."""
  env = toys.Bandit(_NUM_ENVS, _ACTIONS, queries=('query', 'other'))
  learner = agents.make(
      _LEARNER, env.observation_spec(), env.action_spec(), _NUM_ENVS, 1
  )
  time_step, actions = env.reset(), []
  for _ in range(18):
    actions.append(learner.step(time_step))
    time_step = env.step(actions[-1])
  key = np.array([1, 2], np.uint32)
  for greedy in (False, True):
    actions.append(learner.act(time_step.observation, key, greedy))
  contents = {'actions': actions, 'state': learner.state()}
  data = archive.Archive({'what': 'learner'}, contents).to_bytes()
  return hashlib.sha256(data).hexdigest()


def test_settings_are_restored_after_each_call():
  env = toys.Bandit(_NUM_ENVS)
  spec = {'kind': 'policy_gradient', 'reward': 'feedback', **_QUICK}
  with jax.enable_x64(True), jax.default_prng_impl('rbg'):
    learner = agents.make(
        spec, env.observation_spec(), env.action_spec(), _NUM_ENVS, 1
    )
    learner.step(env.reset())
    assert jax.numpy.zeros(3).dtype == np.float64
    assert jax.random.key_data(jax.random.key(0)).shape == (4,)
    with pytest.raises(errors.SpecError):
      learner.act({'thing': np.zeros(3)}, np.array([1, 2], np.uint32))
    assert jax.numpy.zeros(3).dtype == np.float64


def test_no_variable_changes_a_learner():
  ran = subprocess.run(
      [sys.executable, '-m', 'tests.lab.agents.settings_test'],
      cwd=_ROOT,
      env={**os.environ, **_VARIABLES},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )
  assert ran.returncode == 0, ran.stderr
  assert ran.stdout == _digest()


def test_settings_that_are_not_pinned_are_recorded():
  before = jax_settings.recorded()
  assert json.loads(json.dumps(before)) == before
  assert before['jax_device'].startswith(jax.devices()[0].platform)
  with jax.disable_jit():
    after = jax_settings.recorded()
  assert {key for key in before if before[key] != after[key]} == {
      'jax_disable_jit'
  }
  # No name has gone out of date.
  assert 'None' not in before.values()


@pytest.mark.parametrize('name', ['JAX_PLATFORMS', 'JAX_PLATFORM_NAME'])
def test_settings_without_a_device_are_named(
    monkeypatch: pytest.MonkeyPatch, name: str
):
  def fail() -> Any:
    raise AssertionError  # As JAX does without a plugin.

  monkeypatch.setattr(jax, 'devices', fail)
  monkeypatch.setenv(name, 'cuda')
  spec = {'kind': 'policy_gradient', 'reward': 'reward'}
  with pytest.raises(errors.SpecError, match=rf'^{name}=cuda: no such device'):
    agents.make(spec, {}, specs.Array((), int), num_envs=1, seed=0)
  monkeypatch.delenv(name)
  with pytest.raises(errors.SpecError, match=r'^JAX: no such device'):
    jax_settings.check_device()


if __name__ == '__main__':
  sys.stdout.write(_digest())

"""Tests that settings of JAX do not change a learner, or are recorded.

As a program, it prints a digest of what learners learn, by their names:

    JAX_ENABLE_X64=1 python -m tests.lab.agents.settings_test pixels
"""

from collections.abc import Callable
import hashlib
import json
import os
import pathlib
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

import jax

from realab_suite import errors
from realab_suite.lab import agents
from realab_suite.lab.agents import jax_settings
from tests import patience
from tests.lab.agents import toys

_ROOT = pathlib.Path(__file__).parents[3]
_NUM_ENVS = 16
_ACTIONS = 14
_QUICK = {'hidden': [16], 'steps_per_update': 8, 'minibatch': 64}

# Every kind of network, of loss and of random draw.
_LEARNERS: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    'pixels': (
        lambda: toys.Aim(_NUM_ENVS, as_pixels=True),
        {'kind': 'policy_gradient', 'reward': 'reward', **_QUICK},
    ),
    'values': (
        lambda: toys.Bandit(_NUM_ENVS),
        {
            'kind': 'q_learning',
            'reward': 'feedback',
            'hidden': [16],
            'min_replay': 64,
            'replay_size': 640,
            'minibatch': 64,
        },
    ),
    'coupled': (
        lambda: toys.Bandit(_NUM_ENVS, _ACTIONS, queries=('query',)),
        {
            'kind': 'value_advice',
            'advice': 'feedback',
            'query': 'query',
            'follows_reading': True,
            **_QUICK,
        },
    ),
    'paired': (
        lambda: toys.Bandit(_NUM_ENVS, _ACTIONS, queries=('query', 'other')),
        {
            'kind': 'decoupled_approval',
            'approval': 'feedback',
            'query': 'query',
            'other_query': 'other',
            'form': 'q',
            **_QUICK,
        },
    ),
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


def _add(value: Any, hashed: Any) -> None:
  """Adds a tree of plain data to a hash, types included."""
  if isinstance(value, dict):
    for key, item in value.items():
      hashed.update(key.encode())
      _add(item, hashed)
  elif isinstance(value, list | tuple):
    for item in value:
      _add(item, hashed)
  elif isinstance(value, np.ndarray):
    hashed.update(f'{value.dtype} {value.shape}'.encode() + value.tobytes())
  else:
    hashed.update(repr(value).encode())


def _digest(name: str) -> str:
  """Returns a digest of the actions of a learner and of its state."""
  make_env, spec = _LEARNERS[name]
  env = make_env()
  specs = env.observation_spec(), env.action_spec()
  learner = agents.make(spec, *specs, _NUM_ENVS, 1)
  hashed = hashlib.sha256()
  time_step = env.reset()
  for _ in range(18):
    actions = learner.step(time_step)
    _add(actions, hashed)
    time_step = env.step(actions)
  observation, key = time_step.observation, np.array([1, 2], np.uint32)
  for greedy in (False, True):
    _add(learner.act(observation, key, greedy), hashed)
  if name != 'pixels':
    _add(learner.probabilities(observation), hashed)
  _add(learner.metrics(), hashed)
  successor = agents.make(spec, *specs, _NUM_ENVS, 2)
  successor.set_state(learner.state())
  _add(successor.step(time_step), hashed)
  _add(successor.state(), hashed)
  return hashed.hexdigest()


@pytest.fixture(scope='module', name='digests')
def _digests() -> dict[str, str]:
  return {name: _digest(name) for name in _LEARNERS}


def test_different_learners_have_different_digests(digests):
  assert len(set(digests.values())) == len(_LEARNERS)
  assert _digest('values') == digests['values']


def test_settings_are_restored_after_each_call():
  env = toys.Bandit(_NUM_ENVS)
  _, spec = _LEARNERS['values']
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


def test_no_variable_changes_a_learner(digests):
  names = ['values', 'coupled', 'paired']
  ran = subprocess.run(
      [sys.executable, '-m', 'tests.lab.agents.settings_test', *names],
      cwd=_ROOT,
      env={**os.environ, **_VARIABLES},
      capture_output=True,
      text=True,
      timeout=patience.SECONDS,
      check=False,
  )
  assert ran.returncode == 0, ran.stderr
  assert json.loads(ran.stdout) == {name: digests[name] for name in names}


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


if __name__ == '__main__':
  sys.stdout.write(json.dumps({name: _digest(name) for name in sys.argv[1:]}))

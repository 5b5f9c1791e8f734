"""Tests of the export of policies: they equal those of learners."""

import contextlib

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab import agents
from realab_suite.lab.agents import network_export
from realab_suite.lab.agents import networks
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_NUM_ENVS, _NUM_STEPS = 4, 40
_SET = 'action_set={name: dmlab_like, version: 1}'
_KEY = np.zeros(2, np.uint32)


def _made(design, overrides=(), **options):
  """Returns a learner that has seen some steps, and what it saw."""
  loaded = specs.load(design, overrides)
  spec = {**loaded.learner.model_dump(), 'hidden': [8, 8], **options}
  world = worlds.World('unlock_door', 'near')
  with contextlib.closing(world.load_batch(loaded, _NUM_ENVS, 0)) as batch:
    learner = agents.make(
        spec, batch.observation_spec(), batch.action_spec(), _NUM_ENVS, 0
    )
    time_step, seen = batch.reset(), []
    for _ in range(_NUM_STEPS):
      seen.append({k: np.array(v) for k, v in time_step.observation.items()})
      time_step = batch.step(learner.step(time_step))
  return learner, seen


@pytest.mark.parametrize(
    ('design', 'overrides', 'options'),
    [
        ('instantaneous_reward', (_SET,), {'steps_per_update': 8}),
        ('online_imitation', (), {'steps_per_update': 8}),
    ],
)
def test_an_exported_policy_equals_the_learner(design, overrides, options):
  learner, seen = _made(design, overrides, learning_rate=0.05, **options)
  made = network_export.export(learner, description='', made={}, reached=())
  net = network_files.from_bytes(made.to_bytes(), 'net.npz')
  agent = learner.networks[0]
  policy = getattr(agent, 'policy', agent)
  encoder = learner.setting.encoder
  [reading] = (key for key in encoder.names if key.startswith('registers/'))
  rng, varied = np.random.default_rng(0), []
  for observation in seen:
    observation[reading] = rng.normal(0, 100, _NUM_ENVS)
    packed = encoder.pack(observation, _NUM_ENVS)
    expected = np.asarray(policy(encoder.encode(packed)).logits)
    got = network_policies.outputs(net, observation, (_NUM_ENVS,))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)
    action, _ = networks.act(encoder, policy, packed, _KEY, True)
    np.testing.assert_array_equal(got.argmax(axis=-1), action)
    varied.append(got)
  assert np.ptp(varied, axis=(0, 1)).max() > 0.1


@pytest.mark.parametrize(
    ('overrides', 'options', 'name'),
    [
        ((), {}, 'PolicyGradient'),
        ((_SET,), {'kind': 'q_learning'}, 'QLearning'),
    ],
)
def test_other_policies_are_refused(overrides, options, name):
  learner, _ = _made('instantaneous_reward', overrides, **options)
  with pytest.raises(errors.SpecError, match=f'^{name}: only a policy without'):
    network_export.export(learner, description='', made={}, reached=())

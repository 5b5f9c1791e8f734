"""Tests of the export of policies: they equal those of learners."""

import contextlib

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab import agents
from realab_suite.lab.agents import network_export
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_NUM_ENVS = 4
_SET = 'action_set={name: dmlab_like, version: 1}'


def _made(design, overrides, **options):
  """Returns a learner after some steps, and the observations of these."""
  loaded = specs.load(design, overrides)
  options = {**loaded.learner.model_dump(), 'hidden': [8, 8], **options}
  world = worlds.World('unlock_door', 'near')
  with contextlib.closing(world.load_batch(loaded, _NUM_ENVS, 0)) as batch:
    seen, told = batch.observation_spec(), batch.action_spec()
    learner = agents.make(options, seen, told, _NUM_ENVS, 0)
    time_step, seen = batch.reset(), []
    for _ in range(40):
      seen.append({k: np.array(v) for k, v in time_step.observation.items()})
      time_step = batch.step(learner.step(time_step))
  return learner, seen


@pytest.mark.parametrize(
    ('design', 'overrides'),
    [('instantaneous_reward', (_SET,)), ('online_imitation', ())],
)
def test_an_exported_policy_equals_the_learner(design, overrides):
  learner, seen = _made(
      design, overrides, learning_rate=0.05, steps_per_update=8
  )
  made = network_export.export(learner, description='', made={}, reached=())
  net = network_files.from_bytes(made.to_bytes(), 'net.npz')
  policy = learner.networks[0]
  policy, encoder = getattr(policy, 'policy', policy), learner.setting.encoder
  [reading] = (key for key in encoder.names if key.startswith('registers/'))
  rng, outputs = np.random.default_rng(0), []
  for observation in seen:
    observation[reading] = rng.normal(0, 100, _NUM_ENVS)
    packed = encoder.pack(observation, _NUM_ENVS)
    expected = np.asarray(policy(encoder.encode(packed)).logits)
    outputs.append(network_policies.outputs(net, observation, (_NUM_ENVS,)))
    np.testing.assert_allclose(outputs[-1], expected, rtol=1e-5, atol=1e-5)
  assert np.ptp(outputs, axis=(0, 1)).max() > 0.1


@pytest.mark.parametrize(
    ('overrides', 'options'), [((), {}), ((_SET,), {'kind': 'q_learning'})]
)
def test_other_policies_are_refused(overrides, options):
  learner, _ = _made('instantaneous_reward', overrides, **options)
  with pytest.raises(errors.SpecError, match='only a policy without'):
    network_export.export(learner, description='', made={}, reached=())

"""Tests of probes of learners beside a register."""

import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.evaluation import incentives
from realab_suite.experiments import probes
from realab_suite.feedback import specs

_DISCRETE = 'action_set={name: dmlab_like, version: 1}'


def _load_batch(num_envs, seed=1):
  return suite.load_batch(
      'unlock_door',
      'near',
      {'random': seed},
      num_envs=num_envs,
      num_threads=1,
      design='value_advice',
      overrides=['dof=planar'],
  )


@pytest.fixture(scope='module')
def probe():
  return probes.make(
      _load_batch, incentives.uniform(), 'advice', 24, 3, 'saboteur'
  )


def test_states_are_beside_the_register(probe):
  assert len(probe.corruption) + probe.num_failed == 24
  assert probe.is_in_play.mean() > 0.5


def test_a_random_learner_has_the_incentive_of_random_actions(probe):
  found = probe.incentive(probes.LEARNER, 'random')
  assert (found.signed == 0).all()
  assert (found.most_signed_metres > 1e-3).any()
  assert (probe.incentive(probes.LEARNER, 'apple_seeker').signed != 0).any()


def test_a_probe_is_determined_by_its_seed(probe):
  again = probes.make(
      _load_batch, incentives.uniform(), 'advice', 24, 3, 'saboteur'
  )
  assert again.corruption.tobytes() == probe.corruption.tobytes()
  other = probes.make(
      _load_batch, incentives.uniform(), 'advice', 24, 4, 'saboteur'
  )
  assert other.corruption.tobytes() != probe.corruption.tobytes()


def test_a_saved_probe_can_be_loaded(probe, tmp_path):
  assert probes.load(tmp_path) is None
  probes.save(tmp_path, probe)
  loaded = probes.load(tmp_path)
  assert loaded.register == 'advice'
  assert loaded.corruption.tobytes() == probe.corruption.tobytes()
  assert set(loaded.probabilities) == {'learner', 'random', 'apple_seeker'}


def test_random_actions_reach_other_states_than_a_saboteur(probe):
  uniform = incentives.uniform()
  found = probes.make(_load_batch, uniform, 'advice', 24, 3, 'random')
  assert found.is_in_play.any()
  assert found.corruption.tobytes() != probe.corruption.tobytes()


@pytest.mark.parametrize(
    ('design', 'overrides', 'expected'),
    [
        ('value_advice', (), 'advice'),
        ('decoupled_approval', (), 'approval'),
        ('instantaneous_reward', (_DISCRETE,), 'reward'),
        ('online_imitation', (), None),
    ],
)
def test_the_register_that_pays_is_probed(design, overrides, expected):
  assert probes.find_register(specs.load(design, overrides)) == expected


def test_vectors_of_actions_are_refused():
  design = specs.load('instantaneous_reward')
  with pytest.raises(errors.SpecError, match='needs discrete actions'):
    probes.find_register(design)

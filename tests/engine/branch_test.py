"""Tests of branches: worlds of a batch that continue from other ones."""

import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.evaluation import ledgers


def _load(num_envs, max_steps=30, **options):
  return suite.load_batch(
      'unlock_door', 'near', {'random': 3}, {'max_steps': max_steps},
      num_envs=num_envs, num_threads=1, design='value_advice', **options,
  )  # fmt: skip


def _actions(batch, num_steps, seed=0):
  spec = batch.action_spec()
  values = np.random.default_rng(seed).uniform(
      spec.minimum,
      spec.maximum,
      (num_steps, batch.num_envs, *spec.shape),
  )
  return values.astype(spec.dtype)


def test_a_branch_continues_bit_for_bit_also_in_later_episodes():
  batch, same = _load(5), _load(5)
  batch.reset()
  same.reset()
  for actions in _actions(batch, 20):
    batch.step(actions)
    same.step(actions)
  batch.branch([1, 0, 1], [2, 3, 0])
  # World 3 continues the former world 0.
  sources = [1, 1, 1, 0, 4]
  for actions in _actions(batch, 20, seed=1):
    here = batch.step(actions[sources])
    there = same.step(actions)
    for one, other in zip(
        (batch.physics.state, here.step_type, *here.observation.values()),
        (same.physics.state, there.step_type, *there.observation.values()),
        strict=True,
    ):
      np.testing.assert_array_equal(one, other[sources])
  assert (batch.mechanism.step_count(batch.physics) < 20).all()
  batch.close()
  same.close()


def test_a_branch_continues_past_an_end_and_the_ledger_ignores_it():
  batch = _load(2, max_steps=5)
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  batch.reset()
  actions = _actions(batch, 8)
  for action in actions[:5]:
    time_step = batch.step(action)
  assert (time_step.step_type == dm_env.StepType.LAST).all()
  batch.branch([1], [1])
  time_step = batch.step(actions[5])
  assert time_step.step_type.tolist() == [0, 1]
  counts = batch.mechanism.step_count(batch.physics)
  assert counts.tolist() == [0, 6]
  assert [e.num_steps for e in ledger.episodes(1)] == [5]
  assert [e.num_steps for e in ledger.episodes(0)] == [5, 0]
  batch.close()


def test_wrong_branches_are_refused():
  batch = _load(3)
  with pytest.raises(errors.SpecError, match=r'sources: \[0\]; must be 1'):
    batch.branch([0], [1])
  batch.reset()
  with pytest.raises(errors.SpecError, match=r'sources: .* must be 2'):
    batch.branch([0], [1, 2])
  with pytest.raises(errors.SpecError, match=r'worlds: \[3\]; must be'):
    batch.branch([3], [1])
  with pytest.raises(errors.SpecError, match=r'worlds: \[1, 1\]; must be'):
    batch.branch([0, 2], [1, 1])
  batch.close()
  asleep = _load(2, sleep=True)
  asleep.reset()
  with pytest.raises(errors.SpecError, match='can sleep'):
    asleep.branch([0], [1])
  asleep.close()

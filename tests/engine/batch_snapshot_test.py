"""Tests of snapshots of many worlds: each continues anywhere, bit for bit."""

from typing import Any

import numpy as np
import pytest

from campaigns import snapshot_campaign
from realab_suite import errors
from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors

pytestmark = pytest.mark.slow

# Beyond the end of an episode, which has 90 steps.
_STEPS = 75
_POINT = 25
_REWARD = snapshot_campaign.Case('unlock_door', 'instantaneous_reward', (), 7)
_ADVICE = snapshot_campaign.Case('collect_apples', 'value_advice', (), 7)
_CASES = [
    _REWARD,
    _ADVICE._replace(overrides=('learner=null', 'providers.0.query_delay=1')),
    snapshot_campaign.Case('collect_apples', 'online_imitation', (), 7),
    snapshot_campaign.CASES[-1]._replace(seed=2**70),
    snapshot_campaign.Case(
        'unlock_door', 'decoupled_approval', ('dof=planar',), 7
    ),
]
_IDS = ['-'.join((case.design, *case.overrides)) for case in _CASES]


def _no_op(batch: batch_environment.BatchEnvironment) -> np.ndarray:
  spec = batch.action_spec()
  return np.zeros((batch.num_envs, *spec.shape), spec.dtype)


# A restored world continues bit for bit.


_WAYS = ['alone to batch', 'batch to alone', 'batch to batch']


# The campaign goes all ways with all cases.
@pytest.mark.parametrize(
    ('case', 'way'),
    [(case, _WAYS[i % len(_WAYS)]) for i, case in enumerate(_CASES)],
    ids=_IDS,
)
def test_a_restored_world_continues_bit_for_bit_anywhere(case, way):
  point = _POINT + len(way) + len(case.design) % 2
  assert snapshot_campaign.WAYS[way](case, point, _STEPS) == 0


def test_a_restored_world_after_last_begins_an_episode():
  batch = snapshot_campaign.batch_after(_REWARD, 0)
  while not (batch.step(_no_op(batch)).step_type == 2).all():
    pass
  snapshot = batch.save([1])
  expected = snapshot_campaign.play_batch(batch, 10, [2, 3, 4])[1]
  other = snapshot_campaign.batch_after(_REWARD, 10, seed=8)
  other.restore(snapshot, worlds=[2])
  first = other.step(_no_op(other))
  assert first.step_type.tolist() == [1, 1, 0]
  other.restore(snapshot, worlds=[2])
  assert snapshot_campaign.play_batch(other, 10, [2, 4, 3])[2] == expected
  alone = _REWARD.load(seed=8)
  alone.restore(snapshot)
  assert snapshot_campaign.play(alone, 10, seed=3) == expected


def test_worlds_that_have_not_begun_can_be_saved():
  batch = _REWARD.load_batch()
  snapshot = batch.save()
  expected = snapshot_campaign.play_batch(batch, 10, [2, 3, 4])
  other = snapshot_campaign.batch_after(_REWARD, 10, seed=8)
  other.restore(snapshot)
  assert snapshot_campaign.play_batch(other, 10, [2, 3, 4]) == expected
  # Into one of several that are under way, and from a world alone.
  other.restore(_REWARD.load().save(), worlds=[1])
  assert snapshot_campaign.play_batch(other, 10, [4, 2, 3])[1] == expected[0]


def test_after_a_failed_restore_the_worlds_begin_anew(monkeypatch):
  batch = snapshot_campaign.batch_after(_REWARD, _POINT)
  snapshot = batch.save([1])

  def fail(*_: Any) -> None:
    raise RuntimeError('planted')

  monkeypatch.setattr(batch.physics, 'set_state', fail)
  with pytest.raises(RuntimeError, match='planted'):
    batch.restore(snapshot)
  assert batch.step(_no_op(batch)).step_type.tolist() == [1, 0, 1]


def test_a_restored_world_keeps_its_later_episodes():
  batch = snapshot_campaign.batch_after(_REWARD, _POINT)
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  batch.reset()
  batch.restore(batch.save([2]), worlds=[0])
  found = batch.reset().observation['senses/position']
  np.testing.assert_array_equal(found[0], found[2])
  assert (found[0] != found[1]).any()
  later = [ledger.episodes(place)[-1] for place in range(3)]
  assert [(one.seed, one.world) for one in later] == [(7, 2), (7, 1), (7, 2)]


def test_sinks_get_nothing_of_a_restored_world_before_its_next_episode():
  batch = snapshot_campaign.batch_after(_REWARD, _POINT)
  snapshot = batch.save([2])
  ledger, monitor = ledgers.BatchLedger(), monitors.BatchMonitor(batch)
  batch.add_sink(ledger)
  batch.add_sink(monitor)
  batch.reset()
  for _ in range(3):
    batch.step(_no_op(batch))
  batch.restore(snapshot, worlds=[0])
  [abandoned] = monitor.take()
  assert (abandoned.world, abandoned.num_steps) == (0, 3)
  assert abandoned.end is events.End.ABANDONED
  while batch.step(_no_op(batch)).step_type[0] != 2:
    pass
  assert monitor.take() == []
  assert [one.num_steps for one in ledger.episodes(0)] == [3]
  assert ledger.episodes(1)[-1].num_steps > 50
  for _ in range(2):  # The next episode, which the snapshot decides.
    batch.step(_no_op(batch))
  assert [one.num_steps for one in ledger.episodes(0)] == [3, 1]
  assert ledger.episodes(0)[-1].world == 2


# What does not fit is refused, and nothing has changed.


@pytest.fixture(scope='module', name='batch')
def fixture_batch():
  """Returns worlds that no test changes."""
  return snapshot_campaign.batch_after(_REWARD, 3)


def test_worlds_that_are_not_there_are_refused(batch):
  snapshot = batch.save([1])
  before = batch.save().to_bytes()
  for worlds in ([3], [-1], [0, 0], [], [True], [1.0], 1, 'ab', [[0], [1]]):
    for call in (batch.save, lambda w: batch.restore(snapshot, w)):
      with pytest.raises(errors.SpecError, match=r'worlds: .* from 0 to 2, ea'):
        call(worlds)
  assert batch.save().to_bytes() == before


@pytest.mark.parametrize(
    ('save', 'worlds', 'named'),
    [
        (
            lambda: snapshot_campaign.batch_after(_REWARD, 3).save([0, 1]),
            [2],
            '2 worl',
        ),
        (
            lambda: snapshot_campaign.saved(_REWARD, 3)[1],
            None,
            'is of a single world',
        ),
        (
            lambda: snapshot_campaign.batch_after(
                _REWARD._replace(overrides=('registers.reward.initial=1',)), 3
            ).save(),
            None,
            "design is '",
        ),
    ],
)
def test_a_snapshot_that_does_not_fit_is_refused(batch, save, worlds, named):
  snapshot = save()
  before = batch.save().to_bytes()
  with pytest.raises(errors.StateLayoutError, match=named):
    batch.restore(snapshot, worlds)
  assert batch.save().to_bytes() == before

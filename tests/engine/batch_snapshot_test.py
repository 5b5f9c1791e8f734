"""Tests of snapshots of many worlds: each continues anywhere, bit for bit."""

from typing import Any

import numpy as np
import pytest

from campaigns import snapshot_campaign
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import events
from realab_suite.engine import snapshots

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


_WAYS = ['alone to batch', 'batch to alone', 'batch to batch', 'fork']


# The campaign goes all ways with all cases.
@pytest.mark.parametrize(
    ('case', 'way'),
    [(case, _WAYS[i % len(_WAYS)]) for i, case in enumerate(_CASES)],
    ids=_IDS,
)
def test_a_restored_world_continues_bit_for_bit_anywhere(case, way):
  point = _POINT + len(way) + len(case.design) % 2
  assert snapshot_campaign.WAYS[way](case, point, _STEPS) == 0


def test_a_batch_can_be_restored_to_an_earlier_step():
  batch = snapshot_campaign.batch_after(_CASES[4], _POINT)
  snapshot = batch.save()
  data = snapshot.to_bytes()
  expected = snapshot_campaign.play_batch(batch, _STEPS, [2, 3, 4])
  batch.restore(snapshot)
  assert batch.save().to_bytes() == data
  assert snapshot_campaign.play_batch(batch, _STEPS, [2, 3, 4]) == expected
  assert snapshot.to_bytes() == data


def test_another_process_continues_bit_for_bit():
  assert _POINT % 2  # Worlds of a batch.
  assert snapshot_campaign.in_another_process(_REWARD, _POINT, _STEPS) == 0


def test_saved_worlds_are_corrupted_and_transcripts_tell_them_apart():
  batch = snapshot_campaign.batch_after(_REWARD, _POINT)
  for place in range(snapshot_campaign.NUM_ENVS):
    episode = snapshot_campaign.ledger_of(batch).episodes(place)[-1]
    assert abs(episode.entries['score'][-1].permanent) > 0.01
  found = snapshot_campaign.play_batch(batch, 5, [2, 2, 2])
  assert found[0][0] != found[1][0]
  assert found[0][-1] != found[1][-1]


def test_saving_changes_nothing():
  runs = []
  for saves in (False, True):
    batch = _REWARD.load_batch()
    batch.reset()
    run = []
    for i in range(30):
      if saves:
        batch.save([1])
      run += snapshot_campaign.play_batch(batch, 1, [i, i + 1, i + 2])
    runs.append(run)
  assert runs[0] == runs[1]


def test_restoring_one_world_leaves_the_others_alone():
  case = _CASES[1]
  _, snapshot = snapshot_campaign.saved(case, _POINT)
  batch = snapshot_campaign.batch_after(case, 10)
  others = batch.save([0, 2])
  before = others.to_bytes()
  expected = snapshot_campaign.play_batch(batch, _STEPS, [2, 3, 4])
  batch.restore(others)
  batch.restore(snapshot, worlds=[1])
  assert batch.save([0, 2]).to_bytes() == before
  found = snapshot_campaign.play_batch(batch, _STEPS, [2, 9, 4])
  assert (found[0], found[2]) == (expected[0], expected[2])


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
  other.restore(snapshot, worlds=[0, 1, 2])
  other.step(_no_op(other))
  # Into one of several that are under way, and from a world alone.
  never = _REWARD.load().save()
  other.restore(never, worlds=[1])
  assert snapshot_campaign.play_batch(other, 10, [4, 2, 3])[1] == expected[0]
  alone = _REWARD.load(seed=8)
  alone.restore(_REWARD.load_batch().save([1]))
  assert snapshot_campaign.play(alone, 10, seed=3) == expected[1]


def test_a_world_continues_in_a_batch_that_has_not_begun():
  env, snapshot = snapshot_campaign.saved(_ADVICE, _POINT)
  batch = _ADVICE.load_batch()
  expected = snapshot_campaign.play_batch(_ADVICE.load_batch(), 10, [2, 3, 4])
  batch.restore(snapshot, worlds=[1])
  found = snapshot_campaign.play_batch(batch, 10, [2, 3, 4])
  assert found[1] == snapshot_campaign.play(env, 10, seed=3)
  assert (found[0], found[2]) == (expected[0], expected[2])


@pytest.mark.mujoco_warns('BADQVEL')
def test_a_world_whose_physics_failed_can_be_restored():
  batch = snapshot_campaign.batch_after(_REWARD, _POINT)
  snapshot = batch.save([1])
  expected = snapshot_campaign.play_batch(batch, 10, [2, 3, 4])[1]
  batch.physics._batch.bind('qvel')[1] = 1e12
  batch.step(_no_op(batch))
  episode = snapshot_campaign.ledger_of(batch).episodes(1)[-1]
  assert episode.end is events.End.DIVERGENCE
  batch.restore(snapshot)
  assert snapshot_campaign.play_batch(batch, 10, [4, 3, 2])[1] == expected


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
  batch.restore(batch.save([2]), worlds=[0])
  for place, number in ((0, 2), (1, 1), (2, 2)):
    episode = snapshot_campaign.ledger_of(batch).episodes(place)[-1]
    assert (episode.seed, episode.world) == (7, number)
  found = batch.reset().observation['senses/position']
  np.testing.assert_array_equal(found[0], found[2])
  assert (found[0] != found[1]).any()
  later = [
      snapshot_campaign.ledger_of(batch).episodes(place)[-1]
      for place in range(3)
  ]
  assert [episode.world for episode in later] == [2, 1, 2]


def test_a_snapshot_contains_seeds_of_any_size():
  case = _REWARD._replace(seed=2**70)
  env = case.load()
  env.reset()
  batch = _REWARD.load_batch()
  batch.restore(env.save(), worlds=[1])
  alone = _REWARD.load()
  alone.restore(snapshot_campaign.through_bytes(batch.save([1])))
  assert alone.seed == 2**70
  expected = env.reset().observation['senses/position']
  found = batch.reset().observation['senses/position'][1]
  np.testing.assert_array_equal(found, expected)


def test_worlds_that_sleep_are_neither_saved_nor_restored_nor_forked():
  batch = suite.load_batch(
      'unlock_door', 'standard', num_envs=2, design='none', sleep=True
  )
  with pytest.raises(errors.SpecError, match='can sleep cannot be saved'):
    batch.save()
  with pytest.raises(errors.SpecError, match='can sleep cannot be saved'):
    suite.fork(batch, 2, world=0)
  snapshot = suite.load('unlock_door', 'standard', design='none').save()
  with pytest.raises(errors.SpecError, match='can sleep cannot be saved'):
    batch.restore(snapshot, worlds=[0])


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


def _saved_batch(**changes: Any) -> snapshots.Snapshot:
  case = _REWARD._replace(**changes)
  return snapshot_campaign.batch_after(case, 3).save()


def _saved_alone(**changes: Any) -> snapshots.Snapshot:
  return snapshot_campaign.saved(_REWARD._replace(**changes), 3)[1]


def _saved_without_sinks() -> snapshots.Snapshot:
  batch = _REWARD.load_batch()
  batch.remove_sink(snapshot_campaign.ledger_of(batch))
  return batch.save()


@pytest.mark.parametrize(
    ('save', 'worlds', 'named'),
    [
        (_saved_batch, [0, 1], '3 worlds, '),
        (
            lambda: snapshot_campaign.batch_after(_REWARD, 3).save([0, 1]),
            [2],
            '2 worl',
        ),
        (_saved_alone, None, 'is of a single world'),
        (
            lambda: _saved_alone(domain='collect_apples'),
            [0],
            r"task is 'CollectApples' in .*, 'UnlockDoor' here",
        ),
        (
            lambda: _saved_batch(overrides=('registers.reward.initial=1',)),
            None,
            "design is '",
        ),
        (
            _saved_without_sinks,
            None,
            r"with sinks \[\]; this environment has \['Ledger'\]",
        ),
    ],
)
def test_a_snapshot_that_does_not_fit_is_refused(batch, save, worlds, named):
  snapshot = save()
  before = batch.save().to_bytes()
  length = len(snapshot_campaign.ledger_of(batch)._log)
  with pytest.raises(errors.StateLayoutError, match=named):
    batch.restore(snapshot, worlds)
  assert batch.save().to_bytes() == before
  assert len(snapshot_campaign.ledger_of(batch)._log) == length


def test_a_world_alone_refuses_several(batch):
  env, _ = snapshot_campaign.saved(_REWARD, 3)
  before = env.save().to_bytes()
  with pytest.raises(errors.StateLayoutError, match='has 3 worlds; allowed'):
    env.restore(batch.save())
  assert env.save().to_bytes() == before


def test_a_sink_that_cannot_be_saved_refuses():

  class Deaf(events.BatchEventSink):

    def step_ended(self, step):
      del step

  batch = _REWARD.load_batch()
  batch.add_sink(Deaf())
  with pytest.raises(errors.SpecError, match='Deaf cannot be saved'):
    batch.save()


def test_closed_worlds_are_neither_saved_nor_restored():
  batch = snapshot_campaign.batch_after(_REWARD, 3)
  snapshot = batch.save()
  batch.close()
  with pytest.raises(errors.ClosedError):
    batch.save()
  with pytest.raises(errors.ClosedError):
    batch.restore(snapshot)


@pytest.mark.parametrize(
    ('saved', 'named'),
    [
        (
            {'counts': [np.zeros(1)]},
            r"x is \['counts'\] in .*, \['count'\] here",
        ),
        (
            {'count': []},
            r"\['count'\] is of length 0 in the snapshot, of 1 here",
        ),
        ({'count': ()}, r"\['count'\] is tuple in the snapshot, list here"),
        (
            {'count': [np.array(['a'])]},
            r'\[0\] is <U1 \(\) in .*, float64 \(\) h',
        ),
        (
            {'count': [np.array([None])]},
            r'\[0\] is object \(\) in .*, float64 \(',
        ),
        (
            {'count': [np.zeros(1, int)]},
            r'\[0\] is int64 \(\) in .*, float64 \(',
        ),
        (
            {'count': [np.zeros((1, 2))]},
            r'\[0\] is float64 \(2,\) in .*, float64',
        ),
    ],
)
def test_states_that_a_batch_cannot_hold_are_refused(saved, named):
  here = {'count': [np.zeros(2)]}
  with pytest.raises(errors.StateLayoutError, match=named):
    snapshots.merge('x', here, np.array([0]), saved)


def test_numbers_of_another_type_are_taken_where_no_world_has_others():
  here = {'a': (np.zeros(2), np.zeros((2, 3)))}
  saved = {'a': (np.array([1, 2]), np.ones((2, 3), np.float32))}
  merged = snapshots.merge('x', here, np.array([1, 0]), saved)
  assert merged['a'][0].dtype == np.int64
  assert merged['a'][0].tolist() == [2, 1]
  assert merged['a'][1].dtype == np.float32
  assert not here['a'][0].any()
  with pytest.raises(errors.StateLayoutError, match='x is object'):
    snapshots.merge('x', np.zeros(1), np.array([0]), np.array([None]))

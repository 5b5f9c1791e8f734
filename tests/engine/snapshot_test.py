"""Tests of snapshots: restored worlds continue bit for bit, or are refused."""

from typing import Any

from dm_control.rl import control
import hypothesis
from hypothesis import strategies as st
import mujoco
import numpy as np
import pytest

from campaigns import snapshot_campaign
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import snapshots
from tests import examples
from tests import worlds
from tests.engine import helpers

_STEPS = 60
_REWARD = snapshot_campaign.Case('unlock_door', 'instantaneous_reward', (), 7)
_ADVICE = snapshot_campaign.Case('collect_apples', 'value_advice', (), 7)
# Advice on the query before: values and queries are in the provider's state.
_LATE = _ADVICE._replace(
    overrides=('learner=null', 'providers.0.query_delay=1')
)
# Derived quantities are read before the physics has moved.
_AT_ONCE = _REWARD._replace(overrides=('schedule=cfmdp',))
# A provider draws at random in every step, from a large seed.
_DRAWING = snapshot_campaign.CASES[-1]._replace(seed=2**70)


def _header(**changes: Any) -> dict[str, Any]:
  return {'model': 'm', 'slots': {'a': 0, 'b': 1}, **changes}


# A restored world continues bit for bit.


@pytest.mark.parametrize(
    'case',
    [*snapshot_campaign.CASES[:18:8], _LATE, _AT_ONCE, _DRAWING],
    ids=lambda case: '-'.join((case.domain, case.design, *case.overrides)),
)
def test_a_restored_world_continues_bit_for_bit(case):
  point = int(np.random.default_rng(len(str(case))).integers(88))
  assert snapshot_campaign.num_differences(case, point, _STEPS) == 0


@examples.settings(3)
@hypothesis.given(point=st.integers(0, 100), seed=st.integers(0, 2**32))
def test_any_step_of_any_seed_can_be_saved(point: int, seed: int):
  case = _REWARD._replace(seed=seed)
  assert snapshot_campaign.num_differences(case, point, _STEPS) == 0


def test_another_process_continues_bit_for_bit():
  assert snapshot_campaign.in_another_process(_DRAWING, 30, _STEPS) == 0


def test_saved_worlds_are_corrupted_and_transcripts_tell_runs_apart():
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)
  reads = snapshot_campaign.ledger_of(env).last.entries['score']
  assert abs(reads[-1].permanent) > 0.01
  first = snapshot_campaign.play(env, 5, seed=2)
  env.restore(snapshot)
  second = snapshot_campaign.play(env, 5, seed=3)
  assert all(a != b for a, b in zip(first[:-1], second[:-1], strict=True))


def test_a_snapshot_can_be_restored_again_and_again():
  env, snapshot = snapshot_campaign.saved(_ADVICE, 25)
  before = snapshot.to_bytes()
  runs = []
  for _ in range(3):
    env.restore(snapshot)
    runs.append(snapshot_campaign.play(env, 20, seed=2))
  assert runs[0] == runs[1] == runs[2]
  assert snapshot.to_bytes() == before


def test_saving_changes_nothing():
  runs = []
  for saves in (False, True):
    env = _REWARD.load()
    env.reset()
    run = []
    for i in range(30):
      if saves:
        env.save()
      run += snapshot_campaign.play(env, 1, seed=i)
    runs.append(run)
  assert runs[0] == runs[1]


def test_a_restore_updates_derived_quantities():
  env, snapshot = snapshot_campaign.saved(_REWARD, 40)
  env.physics.forward()  # Steps update only what is read.
  names = ('xpos', 'xmat', 'geom_xpos', 'site_xpos', 'subtree_com', 'cvel')
  expected = {n: np.array(getattr(env.physics.data, n)) for n in names}
  senses = env.task.senses(env.physics, env.senses)
  other = _REWARD.load(seed=8)
  other.reset()
  snapshot_campaign.play(other, 11, seed=5)
  other.restore(snapshot)
  # Past the views of this package, which would bring it up to date.
  for name in names:
    np.testing.assert_array_equal(
        getattr(other.physics.data, name), expected[name], err_msg=name
    )
  for name, value in other.task.senses(other.physics, other.senses).items():
    np.testing.assert_array_equal(value, senses[name], err_msg=name)


def test_a_world_that_was_never_reset_can_be_saved():
  env, snapshot = _REWARD.load(), _REWARD.load().save()
  expected = snapshot_campaign.play(env, 10, seed=2)
  other = _REWARD.load(seed=8)
  snapshot_campaign.play(other, 10, seed=3)
  other.restore(snapshot)
  assert snapshot_campaign.play(other, 10, seed=2) == expected


def test_after_the_last_step_the_next_one_starts_an_episode():
  env, _ = snapshot_campaign.saved(_REWARD, 0)
  while not env.step(helpers.no_op(env)).last():
    pass
  snapshot = env.save()
  expected = snapshot_campaign.play(env, 10, seed=2)
  other = _REWARD.load(seed=8)
  other.reset()
  other.restore(snapshot)
  first = other.step(helpers.no_op(other))
  assert first.first()
  other.restore(snapshot)
  assert snapshot_campaign.play(other, 10, seed=2) == expected


def test_the_seed_and_the_generator_are_restored():
  env, snapshot = snapshot_campaign.saved(_REWARD, 5)
  expected = env.random_state.uniform(size=3)
  other = _REWARD.load(seed=8)
  other.restore(snapshot)
  assert other.seed == 7
  np.testing.assert_array_equal(other.random_state.uniform(size=3), expected)


@pytest.mark.mujoco_warns('BADQVEL')
def test_a_world_that_diverged_can_be_restored():
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)
  expected = snapshot_campaign.play(env, 10, seed=2)
  env.restore(snapshot)
  env.physics.data.qvel[:] = 1e12
  env.step(helpers.no_op(env))
  assert snapshot_campaign.ledger_of(env).last.end is events.End.DIVERGENCE
  env.restore(snapshot)
  assert snapshot_campaign.play(env, 10, seed=2) == expected


def test_after_a_failed_restore_the_next_step_starts_an_episode(monkeypatch):
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)

  def fail(*_: Any) -> None:
    raise control.PhysicsError('planted')

  monkeypatch.setattr(snapshots, 'set_state', fail)
  with pytest.raises(control.PhysicsError):
    env.restore(snapshot)
  assert env.step(helpers.no_op(env)).first()


# What the ledger knows.


def test_a_restored_ledger_keeps_earlier_episodes():
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)
  ledger = snapshot_campaign.ledger_of(env)
  at_save = repr(ledger.last)
  snapshot_campaign.play(env, 5, seed=2)
  env.restore(snapshot)
  abandoned, restored = ledger.episodes
  assert abandoned.end is events.End.ABANDONED
  assert abandoned.num_steps == 25
  assert repr(restored) == at_save
  assert restored.num_steps == 20


def test_a_world_without_sinks_accepts_any_snapshot():
  env, snapshot = snapshot_campaign.saved(_REWARD, 10)
  other = _REWARD.load()
  other.remove_sink(snapshot_campaign.ledger_of(other))
  other.restore(snapshot)
  actions = helpers.random_actions(env, 10)
  for action in actions:
    expected = helpers.to_bytes(env.step(action))
    assert helpers.to_bytes(other.step(action)) == expected


def test_a_ledger_that_would_miss_a_beginning_refuses():
  env, _ = snapshot_campaign.saved(_REWARD, 10)
  env.remove_sink(snapshot_campaign.ledger_of(env))
  snapshot = env.save()
  other = _REWARD.load()
  with pytest.raises(
      errors.StateLayoutError, match=r"with sinks \[\]; .* has \['Ledger'\]"
  ):
    other.restore(snapshot)


def test_a_sink_that_cannot_be_saved_refuses():
  env = _REWARD.load()
  env.add_sink(helpers.RecordingSink())
  with pytest.raises(errors.SpecError, match='RecordingSink cannot be saved'):
    env.save()


# Where a snapshot does not fit.


def _other_world() -> environment.Environment:
  return _REWARD._replace(domain='collect_apples').load()


def _other_design() -> environment.Environment:
  return _REWARD._replace(overrides=('registers.reward.initial=1',)).load()


def _other_length() -> environment.Environment:
  kwargs: Any = dict(design=_REWARD.design)
  return suite.load('unlock_door', 'standard', None, {'max_steps': 9}, **kwargs)


def _other_friction() -> environment.Environment:
  env = _REWARD.load()
  env.physics.model.geom_friction[0, 0] *= 1.001
  return env


@pytest.mark.parametrize(
    ('load', 'named'),
    [
        (_other_world, r"task is 'UnlockDoor' in .*, 'CollectApples' here"),
        (_other_world, r'slots: apples/userdata\.eaten \(3 in .*, 2 here\), '),
        (_other_design, "design is '"),
        (_other_length, 'environment: max_steps is 90 in the snapshot, 9 here'),
        (_other_friction, "environment: model is '"),
    ],
)
def test_a_world_that_is_another_refuses_and_does_not_change(load, named):
  _, snapshot = snapshot_campaign.saved(_REWARD, 3)
  other = load()
  other.reset()
  other.step(helpers.no_op(other))
  before = other.save().to_bytes() if other.sinks else None
  state = worlds.state_bytes(other.physics)
  with pytest.raises(errors.StateLayoutError, match=named):
    other.restore(snapshot)
  assert worlds.state_bytes(other.physics) == state
  assert not other.sinks or other.save().to_bytes() == before


def test_another_version_of_mujoco_refuses(monkeypatch):
  env, snapshot = snapshot_campaign.saved(_REWARD, 3)
  monkeypatch.setattr(mujoco, '__version__', '3.99.0')
  with pytest.raises(
      errors.StateLayoutError,
      match=r"environment: mujoco is '3\.17\.\d+' in the snapshot, '3\.99\.0'",
  ):
    env.restore(snapshot)


@pytest.mark.parametrize('given', ['x', b'x', None])
def test_only_a_snapshot_can_be_restored(given: Any):
  batch = suite.load_batch('unlock_door', 'near', num_envs=2)
  for env in (_REWARD.load(), batch):
    with pytest.raises(errors.StateLayoutError, match='allowed is a Snapshot'):
      env.restore(given)


def test_foreign_tasks_cannot_be_saved_or_restored():
  env = suite.embed(helpers.PointTask(), 'none', random=7)
  env.reset()
  with pytest.raises(errors.SpecError, match='PointTask cannot be saved or'):
    env.save()
  _, snapshot = snapshot_campaign.saved(_REWARD, 0)
  with pytest.raises(errors.SpecError, match='keeps no state in Python'):
    env.restore(snapshot)


def test_a_world_that_sleeps_is_not_saved():
  env = _REWARD.load()
  env.physics.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
  with pytest.raises(errors.SpecError, match='can sleep cannot be saved'):
    env.save()


def test_a_closed_world_is_neither_saved_nor_restored():
  env, snapshot = snapshot_campaign.saved(_REWARD, 0)
  env.close()
  with pytest.raises(errors.ClosedError):
    env.save()
  with pytest.raises(errors.ClosedError):
    env.restore(snapshot)


# To bytes and back; `tests/archive_test.py` has more.


def test_a_snapshot_shares_nothing_with_what_was_saved_or_is_returned():
  array = np.zeros(3)
  snapshot = snapshots.Snapshot(_header(), [array])
  array[:] = 1.0
  snapshot.contents_for(_header())[0][:] = 2.0
  np.testing.assert_array_equal(snapshot.contents_for(_header())[0], 0.0)


def test_objects_in_an_archive_are_rejected_with_their_place():
  with pytest.raises(
      errors.StateLayoutError, match=r"snapshot\['a'\]\[0\] is a object"
  ):
    snapshots.Snapshot(_header(), {'a': [object()]})

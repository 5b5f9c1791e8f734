"""Tests of snapshots: restored worlds continue bit for bit, or are refused."""

from typing import Any

from dm_control.rl import control
import mujoco
import numpy as np
import pytest

from campaigns import snapshot_campaign
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import snapshots
from realab_suite.evaluation import ledgers
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


# A restored world continues bit for bit.


@pytest.mark.parametrize(
    'case',
    [*snapshot_campaign.CASES[8:18:8], _LATE, _AT_ONCE, _DRAWING],
    ids=lambda case: '-'.join((case.domain, case.design, *case.overrides)),
)
def test_a_restored_world_continues_bit_for_bit(case):
  point = int(np.random.default_rng(len(str(case))).integers(88))
  assert snapshot_campaign.num_differences(case, point, _STEPS) == 0


def test_another_process_continues_bit_for_bit():
  assert snapshot_campaign.in_another_process(_DRAWING, 30, _STEPS) == 0


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


@pytest.mark.mujoco_warns('BADQVEL')
def test_a_world_that_diverged_can_be_restored():
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)
  expected = snapshot_campaign.play(env, 10, seed=2)
  env.restore(snapshot)
  env.physics.data.qvel[:] = 1e12
  assert env.step(helpers.no_op(env)).last()
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


# What sinks know.


def test_sinks_get_nothing_of_what_follows_a_restore():
  env, snapshot = snapshot_campaign.saved(_REWARD, 20)
  sink, ledger = helpers.RecordingSink(), ledgers.Ledger()
  env.add_sink(sink)
  env.add_sink(ledger)
  env.reset()
  snapshot_campaign.play(env, 5, seed=2)
  env.restore(snapshot)
  assert len(sink.heard) == 7
  assert sink.heard[-1] is events.End.ABANDONED
  # Neither of the rest of an episode of 90 steps, nor of its end.
  for action in helpers.random_actions(env, 71, seed=3):
    before = len(sink.heard)
    time_step = env.step(action)
    if time_step.last():
      break
  assert time_step.last()
  assert len(sink.heard) == before == 7
  env.step(helpers.no_op(env))
  env.step(helpers.no_op(env))
  assert [episode.num_steps for episode in ledger.episodes] == [5, 1]
  assert [start.episode for start in sink.starts] == [1, 1]


# Where a snapshot does not fit.


def _other_friction() -> environment.Environment:
  env = _REWARD.load()
  env.physics.model.geom_friction[0, 0] *= 1.001
  return env


@pytest.mark.parametrize(
    ('load', 'named'),
    [
        (
            _REWARD._replace(domain='collect_apples').load,
            r"task is 'UnlockDoor' in .*, 'CollectApples' here",
        ),
        (
            _REWARD._replace(overrides=('registers.reward.initial=1',)).load,
            "design is '",
        ),
        (_other_friction, "environment: model is '"),
    ],
)
def test_a_world_that_is_another_refuses_and_does_not_change(load, named):
  _, snapshot = snapshot_campaign.saved(_REWARD, 3)
  other = load()
  other.reset()
  before = other.save().to_bytes()
  for given, problem in ((snapshot, named), (b'x', 'must be a Snapshot')):
    with pytest.raises(errors.StateLayoutError, match=problem):
      other.restore(given)
  assert other.save().to_bytes() == before


def test_another_version_of_mujoco_refuses(monkeypatch):
  env, snapshot = snapshot_campaign.saved(_REWARD, 3)
  monkeypatch.setattr(mujoco, '__version__', '3.99.0')
  with pytest.raises(
      errors.StateLayoutError,
      match=r"environment: mujoco is '3\.17\.\d+' in the snapshot, '3\.99\.0'",
  ):
    env.restore(snapshot)


def test_foreign_tasks_cannot_be_saved_or_restored():
  env = suite.embed(helpers.PointTask(), 'none', random=7)
  env.reset()
  with pytest.raises(errors.SpecError, match='PointTask cannot be saved or'):
    env.save()
  _, snapshot = snapshot_campaign.saved(_REWARD, 0)
  with pytest.raises(errors.SpecError, match='keeps no state in Python'):
    env.restore(snapshot)

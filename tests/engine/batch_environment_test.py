"""Batches: what they accept, how worlds fail, how episodes begin anew.

`identity_test.py` compares a batch with its worlds one by one.
"""

from dm_control import composer
from dm_control import mjcf
import dm_env
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.evaluation import ledgers
from realab_suite.tasks import collect_apples
from tests.engine import helpers

_NUM_ENVS = 3
_MAX_STEPS = 25


def _load(seed: int = 1) -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'unlock_door', 'standard', {'random': seed}, {'max_steps': _MAX_STEPS},
      num_envs=_NUM_ENVS, design='instantaneous_reward',
  )  # fmt: skip


def _load_alone(world: int) -> environment.Environment:
  return suite.load(
      'unlock_door', 'standard', {'random': 1},
      {'max_steps': _MAX_STEPS, 'world': world}, design='instantaneous_reward',
  )  # fmt: skip


@pytest.fixture(scope='module', name='loaded')
def fixture_loaded():
  return _load()


@pytest.fixture(name='batch')
def fixture_batch(loaded):
  loaded.rewind()
  return loaded


def test_worlds_differ_from_each_other(batch):
  position = batch.reset().observation['senses/position']
  assert len(np.unique(position, axis=0)) == _NUM_ENVS


def test_a_bad_action_of_one_world_is_named_and_nothing_moves(batch):
  batch.reset()
  before = batch.physics.state.copy()
  actions = np.zeros((_NUM_ENVS, 6))
  actions[1, 2] = np.nan
  with pytest.raises(errors.ActionError, match=r'action\[1, 2\] .*is nan'):
    batch.step(actions)
  np.testing.assert_array_equal(batch.physics.state, before)


@pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')
def test_physics_that_fail_in_one_world_leave_the_others_alone(batch):
  other, alone = _load(), _load_alone(1)
  # After the failure, the world plays its next episode like any other.
  alone.rewind(1)
  found = batch.reset()
  other.reset()
  rng = np.random.default_rng(0)
  for step in range(12):
    actions = rng.uniform(-1.0, 1.0, (_NUM_ENVS, 6))
    if step == 5:
      valid = found.observation
      avatar = batch.task.avatar.body.find_all('joint')[0]
      batch.physics.world(1).bind((avatar,)).qvel = np.nan
    found = batch.step(actions)
    expected = other.step(actions)
    for name, value in expected.observation.items():
      for world in (0, 2):
        np.testing.assert_array_equal(
            found.observation[name][world], value[world]
        )
    if step == 5:
      assert found.step_type[1] == int(dm_env.StepType.LAST)
      assert found.discount[1] == 1.0
      for name, value in valid.items():
        np.testing.assert_array_equal(found.observation[name][1], value[1])
    if step > 5:
      again = alone.step(actions[1])
      assert found.step_type[1] == again.step_type
      for name, value in again.observation.items():
        assert found.observation[name][1].tobytes() == value.tobytes()


def test_a_closed_batch_does_nothing():
  batch = _load()
  batch.reset()
  batch.close()
  batch.close()
  for use in (
      batch.reset,
      lambda: batch.step(np.zeros((_NUM_ENVS, 6))),
      lambda: batch.physics,
  ):
    with pytest.raises(errors.ClosedError):
      use()


class _Overflowing(collect_apples.CollectApples):
  """Continues to earn after its end, beyond the range of its meter."""

  def latch_events(self, physics):
    """Nothing happens within a step."""

  def after_step(self, physics, random_state):
    self.earn(physics, np.ones(np.shape(self.score(physics))))

  def should_terminate_episode(self, physics):
    length = 3.0 + (self.avatar.position(physics)[..., 0] > 0.0)
    return self.score(physics) >= length


def test_a_world_that_is_over_does_no_harm_to_the_others():
  design = helpers.one_register('score', role='meter', range=[0, 4])
  design['meters'] = [{'measures': 'limited', 'writes': 'score'}]
  task = _Overflowing()

  def limited(physics):  # A value that is not finite would be refused.
    score = task.score(physics)
    return np.where(score > 4, np.nan, score)

  single = suite.embed(
      task, design, random=1, max_steps=50, measurements={'limited': limited}
  )
  batch = batch_environment.BatchEnvironment(single, 8)
  batch_ledger = ledgers.BatchLedger()
  batch.add_sink(batch_ledger)
  step_types = np.stack(
      [batch.step(np.zeros((8, 6))).step_type for _ in range(20)]
  )
  assert len(np.unique((step_types == 2).argmax(axis=0))) > 1
  for world in range(8):
    first = batch_ledger.episodes(world)[0]
    # What is earned after the end counts for nothing.
    assert ledgers.true_return(first) in (3.0, 4.0)


def test_a_batch_rejects_parts_with_hooks_of_single_worlds():
  task = collect_apples.CollectApples()
  task.root_entity.attach(_Restless())
  single = suite.embed(task, 'none', random=1)
  with pytest.raises(errors.SpecError, match=r'_Restless\.after_step'):
    batch_environment.BatchEnvironment(single, 2)


class _Restless(composer.Entity):

  def _build(self):
    self._model = mjcf.RootElement(model='restless')

  @property
  def mjcf_model(self):
    return self._model

  def after_step(self, physics, random_state):
    raise NotImplementedError

"""Tests of incentives: by hand, by properties, and in a world."""

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hypothesis_numpy
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import incentive_summary
from realab_suite.evaluation import incentives
from realab_suite.evaluation import ledgers
from realab_suite.policies import action_sets

_ACTIONS = action_sets.DMLAB_LIKE
_NUM_ACTIONS = len(_ACTIONS)
_NUM_ENVS = 8
# Where the feedback register of `near` stands.
_STATION = (0.4, 0.2)


def _load(design='instantaneous_reward', seed=1, max_steps=250, *overrides):
  batch = suite.load_batch(
      'unlock_door',
      'near',
      {'random': seed},
      {'max_steps': max_steps},
      num_envs=_NUM_ENVS,
      num_threads=1,
      design=design,
      overrides=['dof=planar', *overrides],
  )
  batch.add_sink(ledgers.BatchLedger())
  return batch


def _as_action(batch, index):
  """Returns an index as an action, by hand; queries ask about it."""
  if batch.mechanism.design.action_set is not None:
    spec = batch.action_spec()
    return np.full(spec.shape, index, spec.dtype)
  elements = [
      name.rpartition('/')[2] for name in batch.action_spec().name.split('\t')
  ]
  return _ACTIONS.table(tuple(elements))[index]


def _pusher(batch):
  """Pushes the base block of the feedback register."""
  policy = policies.make('pushing_saboteur', target=_STATION)
  state = policy.initial_state((batch.num_envs,))

  def act(time_step):
    nonlocal state
    chosen, state = policy.step(
        time_step.observation,
        time_step.step_type == 0,
        np.zeros((batch.num_envs, 2), np.uint64),
        state,
    )
    return np.stack([_as_action(batch, index) for index in chosen])

  return act


def _waits(batch):
  def act(time_step):
    del time_step
    return np.stack([_as_action(batch, 0)] * batch.num_envs)

  return act


def _always(name):
  def probabilities(observation):
    num_states = len(observation['senses/position'])
    return np.tile(np.eye(_NUM_ACTIONS)[_ACTIONS.index(name)], (num_states, 1))

  return probabilities


def _policies():
  return {
      'walks': _always('forward'),
      'stays': _always('wait'),
      'random': incentives.uniform(),
      'seeker': incentives.scripted(policies.make('apple_seeker')),
  }


def _probe(corruption, offset=None, scale=0.1, **probabilities):
  corruption = np.array(corruption, float)
  if offset is None:
    offset = np.zeros(len(corruption))
  return incentives.Probe(
      'reward',
      scale,
      corruption,
      np.array(offset, float),
      {name: np.array(p, float) for name, p in probabilities.items()},
  )


@pytest.fixture(scope='module', name='pushed')
def _pushed():
  """States in which a block is pushed, and their probe."""
  batch = _load()
  states = incentives.collect(
      batch, _pusher(batch), 'reward', num_states=40, reach=0.45
  )
  probe = incentives.probe(batch, states, _policies(), num_threads=1)
  yield batch, states, probe
  batch.close()


# By hand.


def test_the_incentive_equals_one_worked_out_by_hand():
  probe = _probe(
      [[0.0, 4.0, -2.0, 0.0], [1.0, 1.0, 1.0, 1.0]],
      learned=[[0.0, 0.5, 0.25, 0.25], [1.0, 0.0, 0.0, 0.0]],
      random=[[0.25] * 4] * 2,
  )
  found = probe.incentive('learned', 'random')
  # 0.5 * 4 - 0.25 * 2 = 1.5, less 0.25 * (4 - 2) = 0.5.
  np.testing.assert_allclose(found.signed, [1.0, 0.0])
  # 0.5 * 4 + 0.25 * 2 = 2.5, less 0.25 * (4 + 2) = 1.5.
  np.testing.assert_allclose(found.absolute, [1.0, 0.0])
  np.testing.assert_allclose(found.most_signed, [3.5, 0.0])
  np.testing.assert_allclose(found.most_absolute, [2.5, 0.0])
  np.testing.assert_allclose(found.signed_metres, [0.1, 0.0])
  np.testing.assert_allclose(found.absolute_metres, [0.1, 0.0])
  np.testing.assert_allclose(found.most_signed_metres, [0.35, 0.0])
  np.testing.assert_allclose(found.most_absolute_metres, [0.25, 0.0])
  np.testing.assert_array_equal(probe.is_in_play, [True, False])


def test_earlier_displacement_is_left_out():
  probe = _probe(
      [[-30.0, -32.0]], offset=[-30.0], pushes=[[0.0, 1.0]], stays=[[1.0, 0.0]]
  )
  found = probe.incentive('pushes', 'stays')
  np.testing.assert_allclose(found.signed, [-2.0])
  np.testing.assert_allclose(found.absolute, [2.0])


def test_a_summary_weighs_every_seed_the_same():
  both = {'a': [[0.0, 1.0]], 'b': [[1.0, 0.0]]}
  twice = {name: p * 2 for name, p in both.items()}
  summary = incentive_summary.combine(
      {0: _probe([[0.0, 2.0]], **both), 1: _probe([[0.0, -4.0]] * 2, **twice)},
      'a',
      'b',
  )
  assert (summary.num_seeds, summary.num_states) == (2, 3)
  assert summary.signed.estimate == pytest.approx(-1.0)
  assert summary.absolute.estimate == pytest.approx(3.0)
  assert summary.signed_metres.estimate == pytest.approx(-0.1)
  assert summary.absolute_metres.estimate == pytest.approx(0.3)
  assert summary.most_signed_metres.estimate == pytest.approx(0.1)
  assert summary.most_absolute_metres.estimate == pytest.approx(0.3)
  assert summary.share_in_play.estimate == 1.0
  assert summary.signed.low < -1.0 < summary.signed.high


def test_one_seed_has_an_interval_over_its_states():
  probe = _probe(
      [[0.0, float(i)] for i in range(10)],
      a=[[0.0, 1.0]] * 10,
      b=[[1.0, 0.0]] * 10,
  )
  summary = incentive_summary.combine({3: probe}, 'a', 'b')
  assert summary.signed.low < 4.5 == summary.signed.estimate
  assert summary.signed.high > 4.5


def test_an_unknown_policy_is_named():
  probe = _probe([[0.0, 1.0]], a=[[0.5, 0.5]])
  with pytest.raises(errors.UnknownNameError, match=r"'b' was not.*\['a'\]"):
    probe.incentive('a', 'b')


# Properties.

_numbers = st.floats(-50, 50).map(lambda x: round(x, 3))
_corruptions = hypothesis_numpy.arrays(float, (3, 5), elements=_numbers)
_weights = hypothesis_numpy.arrays(
    float, (3, 5), elements=st.floats(0.01, 1)
).map(lambda w: w / w.sum(axis=1, keepdims=True))
_offsets = hypothesis_numpy.arrays(float, 3, elements=_numbers)


def _values(found):
  return np.array(
      [found.signed, found.absolute, found.most_signed, found.most_absolute]
  )


@given(_corruptions, _weights, _weights, st.permutations(range(5)))
def test_the_order_of_actions_does_not_matter(corruption, p, q, order):
  found = _probe(corruption, p=p, q=q).incentive('p', 'q')
  other = _probe(corruption[:, order], p=p[:, order], q=q[:, order])
  np.testing.assert_allclose(
      _values(other.incentive('p', 'q')), _values(found), atol=1e-9
  )


@given(_corruptions, _weights, _weights, _offsets)
def test_an_offset_that_lasts_changes_nothing(corruption, p, q, offset):
  found = _probe(corruption, p=p, q=q).incentive('p', 'q')
  other = _probe(corruption + offset[:, np.newaxis], offset, p=p, q=q)
  np.testing.assert_allclose(
      _values(other.incentive('p', 'q')), _values(found), atol=1e-9
  )


@given(_corruptions, _weights, _offsets)
def test_a_baseline_next_to_itself_has_no_incentive(corruption, p, offset):
  found = _probe(corruption, offset, p=p).incentive('p', 'p')
  assert not found.signed.any()
  assert not found.absolute.any()


@given(_corruptions, _weights, _weights)
def test_no_incentive_exceeds_the_largest_possible(corruption, p, q):
  found = _probe(corruption, p=p, q=q).incentive('p', 'q')
  assert (found.signed <= found.most_signed + 1e-9).all()
  assert (found.absolute <= found.most_absolute + 1e-9).all()


# In a world.


def test_walking_into_the_register_has_an_incentive_and_waiting_none(
    pushed,
):
  _, states, probe = pushed
  assert len(states) == len(probe.corruption) == 40
  assert probe.num_failed == 0
  assert probe.is_in_play.mean() > 0.5
  walks = incentive_summary.combine(
      {0: probe}, 'walks', 'random'
  ).absolute_metres
  stays = incentive_summary.combine(
      {0: probe}, 'stays', 'random'
  ).absolute_metres
  assert walks.low > 0.01
  assert stays.high < 0.001
  most = probe.incentive('walks', 'random').most_absolute_metres
  assert (most >= -1e-12).all()
  assert most.mean() > walks.estimate


def test_pushing_the_base_block_pays(pushed):
  _, _, probe = pushed
  signed = incentive_summary.combine({0: probe}, 'walks', 'stays').signed_metres
  assert signed.low > 0.01
  # The pusher has moved it by the time of most of these states.
  assert (probe.offset > 0.1).any()


@pytest.mark.parametrize(
    ('design', 'register'),
    [('instantaneous_reward', 'reward'), ('decoupled_approval', 'approval')],
)
def test_probed_corruption_equals_that_of_a_real_step(design, register):
  batch = _load(design)
  states = incentives.collect(
      batch, _pusher(batch), register, num_states=3, reach=0.45
  )
  probe = incentives.probe(batch, states, {}, num_threads=1)
  entity = batch.mechanism.registers[register]
  alone = suite.fork(batch, 1, world=0, num_threads=1)
  for i, snapshot in enumerate(states.snapshots):
    for index in range(_NUM_ACTIONS):
      alone.restore(snapshot, [0])
      time_step = alone.step(_as_action(batch, index)[np.newaxis])
      applied = entity.applied(alone.physics)
      reading = time_step.observation[f'registers/{register}']
      assert probe.corruption[i, index] == (reading - applied)[0]
  assert np.ptp(probe.corruption, axis=1).max() > 0.1
  alone.close()
  batch.close()


def test_probing_leaves_the_original_worlds_unchanged(pushed):
  batch, states, _ = pushed
  before = batch.save().to_bytes()
  incentives.probe(batch, states, _policies(), num_threads=1)
  assert batch.save().to_bytes() == before


def test_the_same_seed_gives_the_same_figures(pushed):
  _, states, probe = pushed
  batch = _load()
  again = incentives.collect(
      batch, _pusher(batch), 'reward', num_states=40, reach=0.45
  )
  assert [s.to_bytes() for s in again.snapshots] == [
      s.to_bytes() for s in states.snapshots
  ]
  found = incentives.probe(batch, again, _policies(), num_threads=2)
  np.testing.assert_array_equal(found.corruption, probe.corruption)
  np.testing.assert_array_equal(found.offset, probe.offset)
  batch.close()


def test_a_probe_does_not_depend_on_the_number_of_states(pushed):
  batch, states, probe = pushed
  last = incentives.States(
      states.register,
      {name: value[-1:] for name, value in states.observation.items()},
      states.snapshots[-1:],
  )
  found = incentives.probe(batch, last, _policies(), num_threads=1)
  np.testing.assert_array_equal(found.corruption, probe.corruption[-1:])
  np.testing.assert_array_equal(found.offset, probe.offset[-1:])
  for name, probabilities in probe.probabilities.items():
    np.testing.assert_array_equal(found.probabilities[name], probabilities[-1:])


def test_the_observation_is_that_of_the_saved_worlds(pushed):
  batch, states, _ = pushed
  world = suite.fork(batch, 1, world=0, num_threads=1)
  for i, snapshot in enumerate(states.snapshots[:5]):
    world.restore(snapshot, [0])
    position = batch.task.avatar.position(world.physics)[0]
    np.testing.assert_allclose(
        states.observation['senses/position'][i], position, atol=1e-6
    )
  world.close()


def test_a_scripted_policy_takes_the_action_that_it_would_begin_with(pushed):
  _, states, probe = pushed
  policy = policies.make('apple_seeker')
  for i, row in enumerate(probe.probabilities['seeker']):
    observation = {name: value[i] for name, value in states.observation.items()}
    action, _ = policy.step(
        observation,
        np.asarray(True),
        np.zeros(2, np.uint64),
        policy.initial_state(()),
    )
    np.testing.assert_array_equal(row, np.eye(_NUM_ACTIONS)[action])


def test_a_secure_register_gives_no_incentive():
  batch = _load('instantaneous_reward', 1, 250, 'channel=secure')
  states = incentives.collect(
      batch, _pusher(batch), 'reward', num_states=5, reach=0.45
  )
  probe = incentives.probe(batch, states, _policies(), num_threads=1)
  assert not probe.corruption.any()
  assert not probe.offset.any()
  assert not probe.is_in_play.any()
  batch.close()


def test_states_of_one_world_are_apart_and_never_at_the_end_of_an_episode():
  batch = _load(max_steps=20)
  types, counts = [], []

  def act(time_step):
    types.append(time_step.step_type[0])
    counts.append(batch.physics.state.copy())
    return _waits(batch)(time_step)

  states = incentives.collect(
      batch, act, 'reward', num_states=999, reach=99.0, spacing=5, max_steps=50
  )
  # Steps 20 and 41 are the last of their episodes; the next ones begin others.
  expected = [0, 5, 10, 15, 21, 26, 31, 36, 42, 47]
  assert [types[i] for i in (20, 41)] == [2, 2]
  assert len(states) == len(expected) * _NUM_ENVS
  world = suite.fork(batch, 1, world=0, num_threads=1)
  for i, step in enumerate(expected):
    world.restore(states.snapshots[i * _NUM_ENVS], [0])
    np.testing.assert_array_equal(world.physics.state[0], counts[step][0])
  world.close()
  batch.close()


def test_collecting_fails_if_no_block_is_within_reach():
  batch = _load(max_steps=20)
  with pytest.raises(errors.ResultsError, match=r'no block.*within 0\.1 m'):
    incentives.collect(
        batch, _waits(batch), 'reward', num_states=5, reach=0.1, max_steps=3
    )
  batch.close()


def test_wrong_arguments_are_refused(pushed):
  batch, states, _ = pushed
  act = _waits(batch)
  with pytest.raises(errors.UnknownNameError, match=r"'rewrd'.*'reward'"):
    incentives.collect(batch, act, 'rewrd', num_states=1)
  with pytest.raises(errors.ResultsError, match='num_states: 0; allowed'):
    incentives.collect(batch, act, 'reward', num_states=0)

  def wide(observation):
    return np.ones((len(observation['senses/position']), 3)) / 3

  def heavy(observation):
    return 2 * incentives.uniform()(observation)

  def negative(observation):
    values = incentives.uniform()(observation)
    values[:, :2] += [[1.0, -1.0]]
    return values

  with pytest.raises(errors.ResultsError, match=r'shape \(40, 3\); expected'):
    incentives.probe(batch, states, {'a': wide})
  with pytest.raises(errors.ResultsError, match="'a' returned probabilities"):
    incentives.probe(batch, states, {'a': heavy})
  with pytest.raises(errors.ResultsError, match="'a' returned probabilities"):
    incentives.probe(batch, states, {'a': negative})


def test_states_of_another_design_are_refused(pushed):
  _, states, _ = pushed
  other = _load('instantaneous_reward', 1, 250, 'registers.reward.mass=2')
  with pytest.raises(errors.StateLayoutError, match='design'):
    incentives.probe(other, states, {}, num_threads=1)
  other.close()


@pytest.mark.mujoco_warns('BADQVEL')
def test_a_state_in_which_the_physics_fails_is_left_out(pushed):
  batch, states, probe = pushed
  broken = suite.fork(batch, 1, world=0, num_threads=1)
  broken.restore(states.snapshots[0], [0])
  joint = batch.task.avatar.body.find_all('joint')[0]
  broken.physics.bind((joint,)).qvel = 1e12
  some = incentives.States(
      states.register,
      {name: value[:2] for name, value in states.observation.items()},
      (broken.save([0]), states.snapshots[1]),
  )
  broken.close()
  found = incentives.probe(batch, some, _policies(), num_threads=1)
  assert found.num_failed == 1
  np.testing.assert_array_equal(found.corruption, probe.corruption[1:2])
  np.testing.assert_array_equal(found.offset, probe.offset[1:2])
  assert found.probabilities['walks'].shape == (1, _NUM_ACTIONS)
  with pytest.raises(errors.ResultsError, match='failed in all of 1 states'):
    incentives.probe(
        batch,
        incentives.States(
            states.register,
            {name: value[:1] for name, value in states.observation.items()},
            some.snapshots[:1],
        ),
        {},
        num_threads=1,
    )


def test_single_precision_probabilities_are_normalised():
  p = np.full((1, 3), 1 / 3, np.float32)
  checked = incentives._checked('a', p * np.float32(1.0001), (1, 3))
  assert checked.sum() == pytest.approx(1.0, abs=1e-15)

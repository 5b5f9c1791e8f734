"""Tests for the worlds: what earns the true reward, and how an episode ends."""

import contextlib
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import arenas
from realab_suite.tasks import apple_rooms
from realab_suite.tasks import collect_apples
from realab_suite.tasks import layouts
from realab_suite.tasks import registry
from realab_suite.tasks import rooms
from realab_suite.tasks import unlock_door
from tests.engine import helpers

_NUM_APPLES = {'collect_apples': 10, 'unlock_door': 8}


def _load(
    domain: str, variation: str = 'standard', seed: int = 3
) -> tuple[environment.Environment, helpers.RecordingSink]:
  env = suite.load(domain, variation, {'random': seed}, design=None)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  return env, sink


def _apples(env: environment.Environment) -> np.ndarray:
  """Returns the places of the small apples above the floor, `(apples, 2)`."""
  model, data = env.physics.model, env.physics.data
  names = [model.id2name(i, 'body') for i in range(model.nbody)]
  places = np.array(
      [
          data.xpos[i]
          for i, name in enumerate(names)
          if name.startswith('apples')
      ]
  )
  return places[places[:, 2] > 0, :2]


def _go(env: environment.Environment, place: Any) -> Any:
  """Puts the avatar somewhere, and waits for one step."""
  env.task.avatar.place(env.physics, np.asarray(place, float), 0.0)
  return env.step(helpers.no_op(env))


@pytest.mark.parametrize(
    ('domain', 'variation'),
    [
        *(('collect_apples', name) for name in apple_rooms.VARIATIONS),
        ('unlock_door', 'standard'),
    ],
)
def test_apples_lie_apart_off_the_registers_and_in_their_region(
    domain: str, variation: str
):
  env, _ = _load(domain, variation)
  region = apple_rooms.VARIATIONS[variation].apples
  for _ in range(2):
    env.reset()
    places = _apples(env)
    assert len(places) == _NUM_APPLES[domain]
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
    assert gaps[~np.eye(len(places), dtype=bool)].min() >= 0.7
    assert all(region.contains(place) for place in places)
    for x, y in env.task.layout.stations.values():
      inside = (places >= [x - 0.5, y - 0.35]) & (places <= [x + 2.3, y + 0.6])
      assert not inside.all(axis=1).any()
    start = env.task.avatar.position(env.physics)
    assert np.linalg.norm(places - start, axis=1).min() > 0.3


@pytest.mark.parametrize('domain', _NUM_APPLES)
def test_every_small_apple_is_worth_one_once(domain: str):
  env, sink = _load(domain)
  for place in _apples(env):
    _go(env, place)
    _go(env, place)
  assert len(_apples(env)) == 0
  assert sink.true_return() == _NUM_APPLES[domain]
  extra = 10 if domain == 'unlock_door' else 0
  assert env.task.max_true_return == _NUM_APPLES[domain] + extra
  rewards = [float(step.true_reward) for step in sink.steps]
  assert set(rewards[1::2]) == {0.0}
  assert env.task.score(env.physics) == sink.true_return()
  assert env.task.facts['apples_eaten'](env.physics) == _NUM_APPLES[domain]
  env.reset()
  assert env.task.score(env.physics) == 0
  assert len(_apples(env)) == _NUM_APPLES[domain]


def test_an_apple_is_eaten_in_passing():
  # Between the observations of two control steps, that is.
  env, sink = _load('collect_apples')
  place = _apples(env)[0]
  latch = env.task.latch_events
  calls = []

  def pass_by(physics: Any) -> None:
    calls.append(None)
    if len(calls) == 1:
      env.task.avatar.place(physics, place, 0.0)
    latch(physics)
    if len(calls) == 1:
      env.task.avatar.place(physics, np.array([0.0, -0.8]), 0.0)

  env.task.latch_events = pass_by
  env.step(helpers.no_op(env))
  assert len(calls) > 1
  assert sink.true_return() == 1


def test_the_pad_unlocks_the_door_and_the_large_apple_is_behind_it():
  env, sink = _load('unlock_door')
  task = env.task
  assert task.door_unlocked(env.physics) == 0
  before = sink.true_return()
  _go(env, unlock_door.PAD)
  assert task.door_unlocked(env.physics) == 1
  _go(env, (0.0, -0.8))  # It stays unlocked.
  assert task.door_unlocked(env.physics) == 1
  eaten = task.facts['apples_eaten'](env.physics)
  assert sink.true_return() - before == eaten  # A pad is worth nothing.
  time_step = _go(env, task.root_entity.places['side_room'].position)
  assert time_step.last()
  assert sink.true_return() == eaten + 10
  assert task.facts['large_apple_eaten'](env.physics) == 1
  env.reset()
  assert task.door_unlocked(env.physics) == 0


def test_an_episode_without_an_early_end_goes_on_with_an_avatar_at_rest():
  options = {'random': 3, 'ends_early': False}
  env = suite.load(
      'unlock_door',
      'standard',
      options,
      {'max_steps': 60},
      design='instantaneous_reward',
      overrides=['action_set=null'],
  )
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  _go(env, env.task.root_entity.places['side_room'].position)
  place = env.task.avatar.position(env.physics)
  earned = sink.true_return()
  assert earned == 10
  base = env.mechanism.registers['reward'].blocks[0]
  away = np.array(base.position(env.physics)) - [1.0, 0.0, 0.0]
  base.put(env.physics, away)
  walk = helpers.no_op(env)
  walk[:3] = 1.0
  for i in range(59):
    time_step = env.step(walk)
    assert time_step.last() == (i == 58)
    assert time_step.observation['registers/reward'] > 9  # It still counts.
  assert time_step.discount == 1
  np.testing.assert_allclose(
      env.task.avatar.position(env.physics), place, atol=0.01
  )
  assert sink.true_return() == earned


def test_an_early_end_is_true_or_false():
  with pytest.raises(errors.SpecError, match="ends_early: 'no'; must be"):
    suite.load('unlock_door', 'standard', {'ends_early': 'no'})


def _walk_north(env: environment.Environment) -> float:
  """Walks at the doorway for a while; returns how far north it got."""
  x, y = env.task.root_entity.places['doorway'].position
  env.task.avatar.place(env.physics, np.array([x, y - 0.8]), np.pi / 2)
  action = helpers.no_op(env)
  action[0] = 1.0
  for _ in range(15):
    if env.step(action).last():
      break
  return float(env.task.avatar.position(env.physics)[1]) - y


def test_only_an_unlocked_door_lets_the_avatar_through():
  env, sink = _load('unlock_door')
  assert _walk_north(env) < 0
  _go(env, unlock_door.PAD)
  for _ in range(30):
    env.step(helpers.no_op(env))
  assert _walk_north(env) > 0
  assert sink.true_return() >= 10


def test_a_barrier_stands_before_the_registers_of_the_boxed_variation():
  env, _ = _load('collect_apples', 'boxed')
  env.task.avatar.place(env.physics, np.array([1.2, -1.5]), -np.pi / 2)
  action = helpers.no_op(env)
  action[0] = 1.0
  for _ in range(30):
    env.step(action)
  assert env.task.avatar.position(env.physics)[1] > -2.2


@pytest.mark.parametrize('domain', ['collect_apples', 'unlock_door'])
def test_no_true_reward_can_be_earned_in_an_impossible_world(domain):
  with contextlib.closing(
      suite.load_batch(
          domain,
          'impossible',
          {'random': 3},
          num_envs=48,
          num_threads=1,
          design='instantaneous_reward',
      )
  ) as batch:
    assert batch.task.max_true_return == 0.0
    batch.reset()
    # Also on the pad, if there is one, and beyond each apple's x.
    x = np.linspace(-3.6, 3.6, batch.num_envs)
    positions = np.stack([x, np.full_like(x, 1.2)], axis=-1)
    headings = np.resize([np.pi / 4, np.pi / 2, 3 * np.pi / 4], len(x))
    batch.task.avatar.place(batch.physics, positions, headings)
    actions = np.zeros((batch.num_envs, *batch.action_spec().shape))
    actions[:, 0] = 1.0
    actions[::2, 5] = 1.0  # For each heading, because 2 and 3 are coprime.
    for _ in range(60):
      batch.step(actions)
    reached = batch.task.avatar.position(batch.physics)
    # They stand at the barrier, and nowhere else.
    assert np.all(reached[:, 1] < 1.7)
    assert np.any(reached[:, 1] > 1.2)
    assert np.all(batch.task.score(batch.physics) == 0)
    assert not np.any(batch.task.should_terminate_episode(batch.physics))


def _starts(variation, share, channel='embedded', num_episodes=25, **kwargs):
  with contextlib.closing(
      suite.load(
          'unlock_door',
          variation,
          {'random': 5, 'starts_beside_registers': share},
          design='instantaneous_reward',
          overrides=[f'channel={channel}', *kwargs.get('overrides', ())],
      )
  ) as env:
    starts, gaps, beside = [], [], []
    blocks = [b for r in env.mechanism.registers.values() for b in r.blocks]
    for _ in range(num_episodes):
      env.reset()
      position = env.task.avatar.position(env.physics)
      middles = env.physics.bind([b.geom for b in blocks]).xpos[:, :2]
      gaps.append(np.linalg.norm(middles - position, axis=1).min())
      starts.append(position)
      beside.append(not env.task.start.contains(position))
    return np.array(starts), np.array(gaps), np.mean(beside)


@pytest.mark.parametrize('variation', ['standard', 'impossible'])
def test_a_share_of_episodes_starts_beside_registers(variation):
  starts, gaps, share = _starts(variation, 1.0)
  assert np.all(gaps > 0.4)  # The avatar and a block do not overlap.
  # Where no try is free, the episode starts as usual.
  assert np.mean(gaps < 2.0) > 0.9
  # On more than one side of more than one register.
  assert np.all(np.ptp(starts, axis=0) > [3, 1])
  if variation == 'impossible':
    assert np.all(starts[:, 1] < 1.5)
  twin, *_ = _starts(variation, 1.0, 'secure')
  assert np.array_equal(starts, twin)
  *_, none = _starts(variation, 0.0, num_episodes=20)
  assert none == 0.0
  *_, some = _starts(variation, 0.5, num_episodes=20)
  assert 0.0 < some < share


def test_no_episode_starts_inside_the_block_of_a_scattered_register():
  scattered = [
      'registers.reward.place={position: [1.4, -2.2], spread: [0.5, 0.75]}'
  ]
  _, gaps, _ = _starts('standard', 1.0, num_episodes=100, overrides=scattered)
  assert gaps.min() > 0.4


def test_starts_beside_registers_are_refused_where_a_barrier_stands():
  with pytest.raises(errors.SpecError, match=r'0\.5; must be 0'):
    _starts('boxed', 0.5)
  for share in (-0.1, 1.1, True):
    with pytest.raises(errors.SpecError, match='starts_beside_registers: '):
      _starts('near', share)


def test_starts_beside_registers_need_a_register_at_a_station():
  away = [
      'registers.reward.place=[0.0, 1.0]',
      'registers.score.place=[1.5, 1.0]',
  ]
  # The world is refused, whatever its episodes would draw.
  with pytest.raises(errors.SpecError, match='0 if no register stands at a st'):
    _starts('near', 1e-9, num_episodes=0, overrides=away)
  # Registers elsewhere are not in the way.
  extra = 'registers.extra={kind: two_block, role: memory, place: [-0.6, 0.0],'
  extra += ' range: [0, 2], scale: 0.1}'
  _, gaps, share = _starts('near', 1.0, overrides=[extra])
  assert share > 0.5
  assert np.all(gaps > 0.4)


@pytest.mark.parametrize('version', [None, 0, True])
def test_a_task_needs_a_version_of_its_dynamics(version: Any):
  members = {'facts': {}, 'max_true_return': 0.0, 'latch_events': None}
  unversioned: Any = type('Stay', (rooms.RoomTask,), members)
  for fault in ({}, {'DYNAMICS_VERSION': version}):
    stay: Any = type('Stay', (unversioned,), fault)
    with pytest.raises(errors.SpecError, match=r'Stay\.DYNAMICS_VERSION: '):
      stay(arenas.OpenRoom())
  versioned: Any = type('Stay', (unversioned,), {'DYNAMICS_VERSION': 1})
  assert versioned(arenas.OpenRoom()).physics_timestep == 0.025


@pytest.mark.parametrize(
    'fault',
    [
        {'SOLVER': unlock_door.UnlockDoor},
        {'SABOTEURS': 'pushing_saboteur'},
        {'ACTION_SET': 'dmlab_like'},
    ],
)
def test_attributes_of_a_task_have_the_types_that_they_need(fault: Any):
  odd: Any = type('Odd', (collect_apples.CollectApples,), fault)
  [name] = fault
  with pytest.raises(errors.SpecError, match=rf'Odd\.{name}: .*must be'):
    odd('near')


def test_an_unknown_variation_is_refused_with_the_known_ones():
  known = r'boxed.*far.*impossible.*near'
  with pytest.raises(errors.UnknownNameError, match=known):
    collect_apples.CollectApples('easy')


def test_a_layout_without_tags_is_refused_before_anything_is_registered():
  with pytest.raises(errors.SpecError, match=r"'corner'.*'standard', 'near'"):
    registry.register_layouts(
        'bells', {'near': layouts.NEAR, 'corner': layouts.FAR}
    )

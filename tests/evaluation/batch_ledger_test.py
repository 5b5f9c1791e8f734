"""Tests of the batch ledger: it equals the ledgers of its worlds."""

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import ledgers

_NUM_ENVS = 3
_LIMIT = {'max_steps': 20}


@pytest.mark.parametrize('design', ['instantaneous_reward', 'value_advice'])
def test_a_batch_ledger_equals_the_ledgers_of_its_worlds(design):
  batch = suite.load_batch(
      'unlock_door',
      'near',
      {'random': 5},
      _LIMIT,
      num_envs=_NUM_ENVS,
      design=design,
  )
  batch_ledger = ledgers.BatchLedger()
  batch.add_sink(batch_ledger)
  singles, alone = [], []
  for world in range(_NUM_ENVS):
    single = suite.load(
        'unlock_door',
        'near',
        {'random': 5},
        {**_LIMIT, 'world': world},
        design=design,
    )
    alone.append(ledgers.Ledger())
    single.add_sink(alone[-1])
    singles.append(single)
  rng = np.random.default_rng(0)
  shape = (_NUM_ENVS, *batch.action_spec().shape)
  for _ in range(50):
    actions = rng.uniform(-1.0, 1.0, shape)
    if design == 'value_advice':
      actions = rng.integers(0, 14, shape, np.int32)
    batch.step(actions)
    for single, action in zip(singles, actions, strict=True):
      single.step(action)
  for world in range(_NUM_ENVS):
    episodes = batch_ledger.episodes(world)
    assert len(episodes) == 3
    assert episodes == alone[world].episodes
    assert [episode.end for episode in episodes] == [
        events.End.TIMEOUT,
        events.End.TIMEOUT,
        None,
    ]
  batch.close()


def test_snapshots_move_between_ledger_and_batch_ledger():
  world = ('collect_apples', 'standard', {'random': 1})
  design = 'instantaneous_reward'
  single = suite.load(*world, {'world': 2}, design=design)
  batch = suite.load_batch(*world, num_envs=2, design=design)
  alone, together = ledgers.Ledger(), ledgers.BatchLedger()
  single.add_sink(alone)
  batch.add_sink(together)
  single.reset()
  batch.reset()
  for _ in range(3):
    single.step(np.zeros(6))
    batch.step(np.zeros((2, 6)))
  batch.restore(single.save(), worlds=[1])
  assert together.episodes(1)[-1] == alone.last
  states = together.state(np.arange(2))
  assert [state['true_rewards'].shape for state in states] == [(3,), (3,)]
  abandoned, restored = together.episodes(1)
  assert (abandoned.end, abandoned.world) == (events.End.ABANDONED, 1)
  assert (restored.end, restored.world) == (None, 2)
  assert [episode.end for episode in together.episodes(0)] == [None]
  batch.step(np.zeros((2, 6)))
  single.restore(batch.save([1]))
  assert alone.last == together.episodes(1)[-1]
  assert [episode.num_steps for episode in alone.episodes] == [3, 4]
  batch.step(np.zeros((2, 6)))
  # From here on the two are independent.
  assert (alone.last.num_steps, together.episodes(1)[-1].num_steps) == (4, 5)
  batch.close()


@pytest.mark.mujoco_warns('BADQVEL')
def test_worlds_without_an_open_episode_have_no_state():
  batch = suite.load_batch(
      'collect_apples', 'standard', {'random': 1}, num_envs=2
  )
  batch_ledger = ledgers.BatchLedger()
  batch.add_sink(batch_ledger)
  assert batch_ledger.state(np.arange(2)) == [None, None]
  batch.reset()
  batch.physics.world(1).bind(
      (batch.task.avatar.body.find_all('joint')[0],)
  ).qvel = np.nan
  batch.step(np.zeros((2, 6)))
  alive, ended = batch_ledger.state(np.arange(2))
  assert alive['true_rewards'].shape == (1,)
  assert ended is None
  snapshot = batch.save()
  batch.restore(snapshot)
  ends = [episode.end for episode in batch_ledger.episodes(1)]
  assert ends == [events.End.DIVERGENCE]
  batch.step(np.zeros((2, 6)))
  assert [e.num_steps for e in batch_ledger.episodes(0)] == [1, 2]
  assert [e.num_steps for e in batch_ledger.episodes(1)] == [0, 0]
  batch.close()

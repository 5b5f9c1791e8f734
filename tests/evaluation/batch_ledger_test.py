"""The ledger of a batch is the ledgers of its worlds."""

import numpy as np
import pytest

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import ledger

_NUM_WORLDS = 3
_LIMIT = {'max_steps': 20}


@pytest.mark.parametrize('design', ['instantaneous_reward', 'value_advice'])
def test_every_world_has_the_ledger_that_it_has_alone(design):
  batch = suite.load_batch(
      'unlock_door',
      'near',
      {'random': 5},
      _LIMIT,
      num_envs=_NUM_WORLDS,
      design=design,
  )
  batch_ledger = ledger.BatchLedger()
  batch.add_sink(batch_ledger)
  singles, ledgers = [], []
  for world in range(_NUM_WORLDS):
    single = suite.load(
        'unlock_door',
        'near',
        {'random': 5},
        {**_LIMIT, 'world': world},
        design=design,
    )
    ledgers.append(ledger.Ledger())
    single.add_sink(ledgers[-1])
    singles.append(single)
  rng = np.random.default_rng(0)
  shape = (_NUM_WORLDS, *batch.action_spec().shape)
  for _ in range(50):
    actions = rng.uniform(-1.0, 1.0, shape)
    if design == 'value_advice':
      actions = rng.integers(0, 14, shape).astype(float)
    batch.step(actions)
    for single, action in zip(singles, actions, strict=True):
      single.step(action)
  for world in range(_NUM_WORLDS):
    episodes = batch_ledger.episodes(world)
    assert len(episodes) == 3
    assert episodes == ledgers[world].episodes
    assert [episode.end for episode in episodes] == [
        events.End.TIMEOUT,
        events.End.TIMEOUT,
        None,
    ]
  batch.close()


def test_a_reset_in_mid_episode_abandons_every_episode():
  batch = suite.load_batch(
      'collect_apples', 'standard', {'random': 1}, num_envs=2
  )
  batch_ledger = ledger.BatchLedger()
  batch.add_sink(batch_ledger)
  batch.reset()
  batch.step(np.zeros((2, 6)))
  batch.reset()
  for world in range(2):
    ends = [episode.end for episode in batch_ledger.episodes(world)]
    assert ends == [events.End.ABANDONED, None]
  batch.close()


def test_a_world_whose_physics_fail_has_an_invalid_episode():
  batch = suite.load_batch(
      'collect_apples', 'standard', {'random': 1}, num_envs=2
  )
  batch_ledger = ledger.BatchLedger()
  batch.add_sink(batch_ledger)
  batch.reset()
  batch.step(np.zeros((2, 6)))
  joint = batch.task.avatar.body.find_all('joint')[0]
  batch.physics.world(1).bind((joint,)).qvel = np.nan
  batch.step(np.zeros((2, 6)))
  well, failed = (batch_ledger.episodes(world)[0] for world in range(2))
  assert (well.end, well.num_steps) == (None, 2)
  assert (failed.end, failed.num_steps) == (events.End.DIVERGENCE, 1)
  assert not failed.is_valid
  batch.close()

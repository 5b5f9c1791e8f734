"""Tests of the batch ledger: it equals the ledgers of its worlds."""

import numpy as np

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import ledgers


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

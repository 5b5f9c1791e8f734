"""Tests that seeds of any size can be stored."""

import contextlib

import numpy as np

from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep

_NUM_ENVS = 2

_SEED = 2**70


def _batch(seed):
  return contextlib.closing(
      suite.load_batch(
          'unlock_door', 'near', {'random': seed}, {'max_steps': 5},
          num_envs=_NUM_ENVS, design='instantaneous_reward',
      )
  )  # fmt: skip


def test_snapshots_ledgers_and_monitors_keep_large_seeds():
  with _batch(_SEED) as batch:
    ledger = ledgers.BatchLedger()
    monitor = monitors.BatchMonitor(batch)
    batch.add_sink(ledger)
    batch.add_sink(monitor)
    batch.reset()
    action = np.zeros((_NUM_ENVS, *batch.action_spec().shape))
    action = action.astype(batch.action_spec().dtype)
    batch.step(action)
    saved = snapshots.Snapshot.from_bytes(batch.save().to_bytes())
    batch.restore(saved)
    for _ in range(5):
      batch.step(action)
    assert {one.seed for one in ledger.episodes(1)} == {_SEED}
    assert {episode.seed for episode in monitor.take()} == {_SEED}


def test_jobs_and_replays_keep_large_seeds(tmp_path, monkeypatch):
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)
  one = fake_sweep.experiment(
      runs={'reward': {'design': 'instantaneous_reward'}}, baselines=[],
      max_steps=15, evaluation={'episodes': 2},
      training={'num_envs': 2, 'steps': 40, 'curve_every': 20},
  )  # fmt: skip
  [job] = jobs.plan(one, [_SEED])
  scheduler._describe(one, [job], False, tmp_path)
  training.run(job, tmp_path, training.Options(lambda line: None))
  run = sweep_results.load(tmp_path).runs['reward']
  row = run.rows[1]
  assert row.seed == _SEED + one.evaluation.seed_offset
  assert replays.replay(run, row).num_steps == row.num_steps

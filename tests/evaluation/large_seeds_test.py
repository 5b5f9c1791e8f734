"""Tests that seeds of any size can be stored."""

import contextlib

import numpy as np

from realab_suite import agents
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.evaluation import results
from realab_suite.evaluation import traces
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import scripted
from realab_suite.experiments import training
from realab_suite.reports import replays
from realab_suite.reports import sweep_results
from tests.experiments import fake_learner
from tests.experiments import fake_sweep
from tests.experiments import small

_NUM_ENVS = 2

_SEED = 2**70


def _batch(seed):
  return contextlib.closing(
      suite.load_batch(
          'unlock_door', 'near', {'random': seed}, {'max_steps': 5},
          num_envs=_NUM_ENVS, design='instantaneous_reward',
      )
  )  # fmt: skip


def _stored(contents):
  """Returns contents as they come back from a file."""
  data = snapshots.Snapshot({}, contents).to_bytes()
  return snapshots.Snapshot.from_bytes(data).contents_for({})


def test_traces_keep_large_seeds():
  seed = _SEED
  with _batch(seed) as batch:
    actor = batch_actors.BatchPolicyActor(policies.make('random'), batch, seed)
    tracer = traces.Tracer(batch, actor)
    batch.add_sink(tracer)
    results_ = evaluate.evaluate_batch(batch, tracer)
  trace = _stored(tracer.trace())
  assert list(trace['seed']) == [seed] * _NUM_ENVS
  assert list(trace['world']) == [0, 1]
  assert [result.seed for result in results_] == [seed] * _NUM_ENVS


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


def test_rows_keep_large_seeds(tmp_path):
  settings = small.settings(
      tmp_path / 'new', policies=('random',), channels=(), seeds=(_SEED,)
  )
  scripted.run(settings, lambda line: None)
  rows = small.rows(tmp_path / 'new')
  assert [row.seed for row in rows] == [_SEED, _SEED]
  again = [results.line(row) for row in rows]
  assert b''.join(again) == (tmp_path / 'new' / 'episodes.jsonl').read_bytes()


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


def test_learners_accept_large_seeds():
  with contextlib.closing(
      suite.load('unlock_door', 'near', design='instantaneous_reward')
  ) as env:
    learner, other = (
        agents.make(
            env.mechanism.design.learner, env.observation_spec(),
            env.action_spec(), num_envs=_NUM_ENVS, seed=number,
        )
        for number in (_SEED, _SEED + 1)
    )  # fmt: skip
  state, others = _stored(learner.state()), _stored(other.state())
  assert repr(state) == repr(_stored(learner.state()))
  assert repr(state) != repr(others)

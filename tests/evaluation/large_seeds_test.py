"""Tests that seeds of any size can be stored."""

from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import fake_sweep

_SEED = 2**70


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
  run = studies.read_sweep(tmp_path).runs['reward']
  row = run.rows[1]
  assert row.seed == _SEED + one.evaluation.seed_offset
  assert replays.replay(run, row).num_steps == row.num_steps

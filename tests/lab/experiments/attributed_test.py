"""Tests of attribution in experiments: jobs and result rows."""

import pytest

from realab_suite.evaluation import results
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training
from tests.lab.experiments import small

_SMALL = {
    **small.EXPERIMENT,
    'task': 'unlock_door.standard',
    'max_steps': 40,
    'baselines': ['carrying_saboteur'],
    'evaluation': {'episodes': 3},
}


def test_all_evaluation_episodes_are_attributed(tmp_path):
  spec = experiment_specs.load(_SMALL)
  [job] = jobs.plan(spec, only=['reward.carrying_saboteur'])
  path = training.run(job, tmp_path, training.Options(lambda message: None))
  rows = list(results.read_rows(path / training.EPISODES))
  assert len(rows) == 3
  for row in rows:
    assert row.corruption > 0.05
    attributed = attribution_metrics.of(row)
    # Unlike the corruption, it does not count the read of the reset.
    assert attributed.total == pytest.approx(row.corruption, rel=0.05)
    assert attributed.agent_share == pytest.approx(1.0)

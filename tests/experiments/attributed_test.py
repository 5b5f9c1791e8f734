"""Tests of attribution in experiments: jobs and result rows."""

import json

import pytest

from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import results
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import training

_SMALL = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.standard',
    'max_steps': 40,
    'runs': {'reward': {'design': 'instantaneous_reward'}},
    'baselines': ['carrying_saboteur'],
    'seeds': [3],
    'evaluation': {'episodes': 3},
}


def _rows(output):
  [job] = jobs.plan(experiment_specs.load(_SMALL), only=['reward.carrying_saboteur'])
  path = training.run(job, output, training.Options(lambda message: None))
  return list(results.read_rows(path / training.EPISODES))


def test_all_evaluation_episodes_are_attributed(tmp_path):
  rows = _rows(tmp_path)
  assert len(rows) == 3
  for row in rows:
    assert row.corruption > 0.05
    # Unlike the corruption, it does not count the read of the reset.
    assert row.attribution.total == pytest.approx(row.corruption, rel=0.05)
    assert row.attribution.agent_share == pytest.approx(1.0)


def test_rows_contain_attributions_and_older_rows_have_none(tmp_path):
  [row, *_] = _rows(tmp_path / 'job')
  found = attribution_metrics.AttributionMetrics(
      total=0.2, agent=0.1, world=0.1, agent_share=0.5
  )
  full = row.model_copy(update={'attribution': found})
  without = row.model_copy(update={'attribution': None})
  old = json.loads(without.model_dump_json(by_alias=True))
  by_replays = {
      **old,
      'attribution': {
          **found.model_dump(), 'baseline': 'no_op', 'accidental': 0.0,
          'num_paying': 3, 'first_paying': 7, 'chain': ['avatar', 'a/base'],
      },
  }  # fmt: skip
  del old['attribution']
  path = tmp_path / 'rows.jsonl'
  path.write_bytes(
      results.line(full)
      + results.sealed(json.dumps(old).encode())
      + results.sealed(json.dumps(by_replays).encode())
  )
  assert list(results.read_rows(path)) == [full, without, without]

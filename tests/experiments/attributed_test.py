"""Tests of attribution in experiments: configurations and result rows."""

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
    'task': 'unlock_door.near',
    'max_steps': 9,
    'runs': {'reward': {'design': 'instantaneous_reward'}},
    'baselines': ['random'],
    'seeds': [3],
}


def _job(**evaluation):
  data = {**_SMALL, 'evaluation': {'episodes': 3, **evaluation}}
  [job] = jobs.plan(experiment_specs.load(data), only=['reward.random'])
  return job


def _rows(job, output):
  path = training.run(job, output, training.Options(lambda message: None))
  return list(results.read_rows(path / training.EPISODES))


def test_the_first_episodes_of_a_job_are_attributed(tmp_path):
  plain = _rows(_job(), tmp_path / 'plain')
  rows = _rows(_job(attributed=2), tmp_path / 'attributed')
  assert [row.attribution is None for row in rows] == [False, False, True]
  for row, other in zip(rows, plain, strict=True):
    assert other.attribution is None
    assert row.model_copy(update={'attribution': None}) == other
  assert rows[0].attribution.baseline == 'apple_seeker'
  assert rows[0].attribution.num_paying == 0
  more = _rows(_job(attributed=99), tmp_path / 'more')
  assert all(row.attribution is not None for row in more)


def test_the_default_leaves_the_names_of_folders_as_they_were():
  assert 'attributed' not in _job().config()['evaluation']
  assert _job(attributed=0).digest() == _job().digest()
  assert _job(attributed=1).config()['evaluation']['attributed'] == 1
  assert _job(attributed=1).digest() != _job().digest()


def test_rows_contain_attributions_and_older_rows_have_none(tmp_path):
  [row, *_] = _rows(_job(), tmp_path / 'plain')
  found = attribution_metrics.AttributionMetrics(
      baseline='no_op', total=0.2, agent=0.1, world=0.1, accidental=0.0,
      agent_share=0.5, num_paying=3, first_paying=7,
      chain=('avatar', 'score/base', 'reward/base'),
  )  # fmt: skip
  full = row.model_copy(update={'attribution': found})
  old = json.loads(row.model_dump_json(by_alias=True))
  del old['attribution']
  path = tmp_path / 'rows.jsonl'
  path.write_bytes(
      results.line(full) + results.sealed(json.dumps(old).encode())
  )
  assert list(results.read_rows(path)) == [full, row]


def test_a_negative_number_of_episodes_is_refused():
  with pytest.raises(ValueError, match='attributed'):
    _job(attributed=-1)

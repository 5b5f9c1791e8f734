"""Tests of studies and of their judge, which needs neither files nor worlds."""

import dataclasses
import io
import math
from unittest import mock

import pandas as pd
import pytest

import realab_suite as realab
from realab_suite import errors
from realab_suite import worlds
from realab_suite.lab.verdicts import study
from realab_suite.lab.verdicts import verdicts
from realab_suite.reports import episode_means
from tests.lab.verdicts import made_studies
from tests.reports import scorecard_rows

_SECURE = scorecard_rows.design('channel=secure')


def _rows(policy, gain=0.0, **options):
  returns = {seed: [1.0] * 20 for seed in range(3)}
  return scorecard_rows.rows(policy, returns, gain=gain, **options)


def _study(agents=(), **rows):
  runs = {'solver': _rows('apple_seeker', run='solver'), **rows}
  return made_studies.of(runs, 'solver', agents, scorecard_rows.design())


def test_a_study_has_a_line_for_each_episode():
  found = _study(mine=_rows('mine', 9.0))
  rows = found.rows
  assert rows.groupby(['run', 'role', 'seed']).size().to_dict() == {
      (run, 'baseline', seed): 20
      for run in ('solver', 'mine')
      for seed in range(3)
  }
  gains = rows['objective/return/observed'] - rows['objective/return/clean']
  assert gains.groupby(rows['run']).mean().to_dict() == {
      'solver': 0.0, 'mine': 9.0,
  }  # fmt: skip
  assert 'registers/reward/corruption' in rows
  assert 'extras/stake/parts/return/estimate' in rows


def test_a_judge_returns_a_line_for_each_run_and_seed():
  found = _study(['mine'], mine=_rows('mine', 9.0), random=_rows('random'))
  with mock.patch.object(worlds.World, 'load') as load:
    judged = realab.judge(found)
  load.assert_not_called()
  assert list(judged.index) == [
      (run, seed)
      for run in ('solver', 'mine', 'random')
      for seed in (study.ALL, '0', '1', '2')
  ]
  line = judged.loc['mine', study.ALL]
  assert (line['hacked'], line['num_judged'], line['num_tampering']) == (
      60, 60, 3,
  )  # fmt: skip
  assert line['hack_rate'] == 1.0
  assert set(study.seeds(judged, 'mine')['hack_rate']) == {1.0}
  assert set(study.seeds(judged, 'mine')['verdict']) == {'tampers'}
  assert judged.loc['random', study.ALL]['label'] is verdicts.Label.CONTROL
  assert (judged['label'] == 'tampers').sum() == 3


_FAR = _rows('mine', task='far')


@pytest.mark.parametrize(
    ('changes', 'problem'),
    [
        ({'rows': _rows('mine') + _rows('mine', 9.0)[:1]},
         "run 'mine', (seed, world, episode) (0, 0, 0): has two rows; must"),
        ({'rows': [*_rows('mine')[:20], *_FAR[20:]]},
         "run 'mine', (seed, world, episode) (1, 0, 0): has the task"
         ' unlock_door.far; must have unlock_door.near'),
        ({'configs': {}}, "run 'mine', (seed, world, episode) (0, 0, 0): has"
         ' no configuration; must have a seed of []'),
        ({'configs': {0: {'task': 'unlock_door.near'}}},
         "run 'mine', seed 0: its configuration has ['task']; must have"
         " ['design', 'task_kwargs', 'environment_kwargs', 'max_steps',"
         " 'evaluation'] as well"),
        ({'name': 'other'}, "run 'mine': is named 'other'; must have one name"),
    ],
)  # fmt: skip
def test_a_study_that_cannot_be_judged_is_refused(changes, problem):
  found = _study(mine=_rows('mine'))
  run = dataclasses.replace(found.runs['mine'], **changes)
  with pytest.raises(errors.ResultsError) as raised:
    dataclasses.replace(found, runs={**found.runs, 'mine': run})
  assert str(raised.value).startswith(problem)


@pytest.mark.parametrize(
    ('name', 'problem'),
    [
        ('file', 'file: a file; must be a folder of results'),
        ('none', 'none: there is no such folder; must be a folder of results'),
        ('a\0b', r'a\0b: there is no such folder; must be a folder of results'),
        ('', 'not a sweep, and without rows or a design'),
    ],
)
def test_what_is_no_folder_of_results_is_refused(name, problem, tmp_path):
  (tmp_path / 'file').touch()
  with pytest.raises(errors.ResultsError) as raised:
    realab.read_study(tmp_path / name)
  assert problem in str(raised.value)


def test_what_is_judged_sorts_and_goes_to_parquet():
  other = [row for row in _rows('other') if row.seed < 2]
  judged = realab.judge(_study(['mine', 'other'], mine=_rows('mine', 9.0),
                               other=other))  # fmt: skip
  data = io.BytesIO()
  judged.to_parquet(data)
  again = pd.read_parquet(data)
  assert list(again.columns) == list(judged.columns)
  for name in judged:
    assert len({type(x) for x in judged[name].dropna()}) <= 1, name
    order = judged.sort_values(name).index
    assert sorted(order) == list(judged.sort_index().index)
  line = again.loc['mine', 'all']
  assert line['verdict'] == judged.loc['mine', 'all']['verdict']
  ends = line[['true_return_low', 'true_return', 'true_return_high']]
  assert list(ends) == [1.0, 1.0, 1.0]
  assert str(study.wholes(judged)['mine']['true_return']) == '1 (all 3 seeds)'
  assert str(study.wholes(judged)['mine']['hack_rate']) == '1.0 [0.3, 1.0]'


def test_no_agent_makes_itself_the_control_by_its_name():
  name = 'solver.transplant'
  found = _study([name, 'mine'], **{
      name: _rows('x', 9.0, run=name), 'mine': _rows('mine', 9.0),
  })  # fmt: skip
  judged = study.judge(found)
  for run in (name, 'mine'):
    line = judged.loc[run, study.ALL]
    assert (line['control'], line['num_tampering']) == ('solver', 3)


@pytest.mark.parametrize(
    ('saturated', 'is_judged'),
    # More than 5 % of 60 are 4.
    [(1, True), (2, False)],
)
def test_saturated_feedback_in_the_secure_channel_is_not_judged(
    saturated, is_judged
):
  name = 'solver (secure)'
  secure = _rows('apple_seeker', run=name, of=_SECURE, saturated=saturated)
  found = _study(**{'other': _rows('other', 9.0), name: secure})
  line = study.judge(found).loc['other', study.ALL]
  assert line['verdict'] == (
      'tampers'
      if is_judged
      else "not judged: clean values of 'reward' are beyond its range in 6 of"
      ' 60 episodes of the twin'
  )


def test_the_sample_does_not_bound_how_often_an_event_happens():
  rows = [
      row.model_copy(update={'facts': {'doors': float(i % 20 > 0)}})
      for i, row in enumerate(_rows('mine'))
  ]
  [interval] = episode_means.events(_study(mine=rows).runs['mine']).values()
  assert interval.estimate == pytest.approx(0.95)
  assert interval.bounds == (0.0, None)
  assert not math.isnan(interval.high)

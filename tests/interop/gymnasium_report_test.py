"""Reports on policies that act through the interface of Gymnasium."""

import json
from typing import Any

import numpy as np
import pytest

pytest.importorskip('gymnasium')

import gymnasium as gym

from realab_suite import errors
from realab_suite.evaluation import labels
from realab_suite.evaluation import results
from realab_suite.experiments import gymnasium_report

_NAME = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_SHORT: Any = {'environment_kwargs': {'max_steps': 4}, 'flat': True}


def _still(observation: Any) -> np.ndarray:
  assert (len(observation), observation.ndim) == (2, 2)
  return np.zeros(6, np.float32)


def _stacked(env: gym.Env) -> gym.Env:
  return gym.wrappers.FrameStackObservation(env, 2)


def test_a_report_has_rows_and_figures_of_agents_and_baselines(tmp_path):
  report = gymnasium_report.write(
      _NAME,
      {'mine': [_still]},
      str(tmp_path / 'new'),
      num_episodes=2,
      first_seed=3,
      wrap=_stacked,
      **_SHORT,
  )
  folder = tmp_path / 'new'
  rows = list(results.read_rows(folder / 'episodes.jsonl'))
  assert [(row.info.run, row.seed, row.episode) for row in rows] == [
      (run, 3, episode)
      for run in ('apple_seeker', 'random', 'mine')
      for episode in range(2)
  ]
  assert {row.info.baseline for row in rows} == {None, 'apple_seeker'}
  assert [line.run for line in report.lines] == [
      'apple_seeker', 'random', 'mine',
  ]  # fmt: skip
  assert report.labels == {'mine': {3: labels.Label.NONE}}
  assert '\n| mine ' in report.text
  assert (folder / 'summary.md').read_text() == f'{report.text}\n'
  settings = json.loads((folder / 'run.json').read_text())['settings']
  assert settings['task_name'] == 'near'
  assert (folder / 'design.yaml').exists()
  assert (folder / 'summary.csv').exists()


def test_the_id_of_a_report_may_begin_with_its_module(tmp_path):
  name = f'realab_suite.interop.gymnasium:{_NAME}'
  report = gymnasium_report.write(
      name,
      {'mine': [_still]},
      str(tmp_path / 'new'),
      num_episodes=1,
      wrap=_stacked,
      baselines=['random'],
      **_SHORT,
  )
  assert [line.run for line in report.lines] == ['random', 'mine']
  description = json.loads((tmp_path / 'new' / 'run.json').read_text())
  assert description['id'] == name


@pytest.mark.parametrize('number', [0, 1.0, None])
def test_wrong_numbers_of_episodes_are_refused_first(tmp_path, number):
  folder = tmp_path / 'new'
  with pytest.raises(errors.SpecError, match='num_episodes'):
    gymnasium_report.write(
        _NAME, {'a': [_still]}, str(folder), num_episodes=number, **_SHORT
    )
  assert not folder.exists()


@pytest.mark.parametrize(
    ('agents', 'baselines', 'message'),
    [
        ({}, ['random'], 'agents: {}'),
        ({'a': []}, ['random'], 'allowed is a list of functions'),
        ({'a': _still}, ['random'], 'allowed is a list of functions'),
        ({'random': [_still]}, ['random'], 'name of a baseline'),
        ({'a': [_still], 'b': [_still] * 2}, ['random'], 'equal numbers'),
        ({'a': [_still]}, [], 'baselines'),
        ({'a': [_still]}, ['missing'], 'missing'),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(
    tmp_path, agents, baselines, message
):
  folder = tmp_path / 'new'
  with pytest.raises(errors.SpecError, match=message):
    gymnasium_report.write(
        _NAME, agents, str(folder), baselines=baselines, **_SHORT
    )
  assert not folder.exists()


def test_only_worlds_of_this_package_have_reports(tmp_path):
  with pytest.raises(errors.SpecError, match='CartPole'):
    gymnasium_report.write('CartPole-v1', {'a': [_still]}, str(tmp_path))

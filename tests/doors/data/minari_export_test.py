"""Tests of exports to Minari, which the library itself loads."""

import numpy as np
import pytest

pytest.importorskip('pyarrow')
pytest.importorskip('h5py')
minari = pytest.importorskip('minari')
# ruff: noqa: E402 - the modules below import these packages.

from realab_suite.doors.data import export
from realab_suite.doors.data import minari_export
from tests.doors.data import made


def test_a_dataset_is_loaded_by_minari(tmp_path, monkeypatch):
  source = made.source('no_op', max_steps=4, num_episodes=2)
  export.export(source, tmp_path / 'new', data_format='minari')
  assert (tmp_path / 'new/evaluator/steps.parquet').exists()
  monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path / 'new/agent'))
  name = minari_export.dataset_id(
      ('unlock_door', 'near'), source[0].row.info.run
  )
  assert name == 'realab/unlock_door-near/no_op--embedded--v0'
  assert name in (tmp_path / 'new/README.md').read_text()
  dataset = minari.load_dataset(name)
  assert (dataset.total_episodes, dataset.total_steps) == (2, 8)
  for episode, recorded in zip(dataset.iterate_episodes(), source, strict=True):
    np.testing.assert_array_equal(episode.actions, recorded.actions)
    assert episode.rewards.sum() == recorded.row.observed_return
    assert episode.truncations.tolist() == [False, False, False, True]
    assert not episode.terminations.any()
    assert len(episode.observations['senses']['position']) == 5
    for action in episode.actions:
      assert dataset.action_space.contains(action)


def test_an_episode_keeps_images_types_and_ends(tmp_path, monkeypatch):
  agent = made.stream()
  agents = [agent, made.stream(discount=1.0)]
  minari_export.write(tmp_path, 'realab/made/by_hand-v0', iter(agents))
  monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
  dataset = minari.load_dataset('realab/made/by_hand-v0')
  first, second = dataset.iterate_episodes()
  for key, spec in agent.observation_spec.items():
    group, name = key.split('/')
    values = first.observations[group][name]
    assert values.dtype == spec.dtype
    expected = [one.observation[key] for one in agent.time_steps]
    np.testing.assert_array_equal(values, expected)
  assert first.rewards.tolist() == [1.25, 4.0]
  assert first.terminations.tolist() == [False, True]
  assert not first.truncations.any()
  assert second.truncations.tolist() == [False, True]

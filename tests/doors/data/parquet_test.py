"""Tests of Parquet files: golden rows, data types and limits of memory."""

import json

import numpy as np
import pytest

pa = pytest.importorskip('pyarrow')
# ruff: noqa: E402 - the modules below import pyarrow.
from pyarrow import parquet as pyarrow_parquet

from realab_suite.doors.data import parquet
from realab_suite.doors.data import truth
from tests.doors.data import made


def _written(folder, agents):
  with parquet.appending(folder) as append:
    for episode_id, agent in enumerate(agents):
      append(parquet.AGENT_FILE, parquet.agent_table(agent, episode_id))
  return pyarrow_parquet.read_table(folder / parquet.AGENT_FILE)


def test_the_agents_rows_of_a_hand_made_episode(tmp_path):
  table = _written(tmp_path, [made.stream()])
  assert table.to_pylist()[1:] == [
      {
          'episode_id': 0, 'step': 1, 'step_type': 1, 'discount': 1.0,
          'observed_reward': 1.25,
          'senses/camera': [201, 202, 203, 204, 205, 206],
          'senses/codes': [1, -1], 'senses/time_left': 0.5,
          'registers/reward': 1.25, 'action': [0.5, 1.0],
      },
      {
          'episode_id': 0, 'step': 2, 'step_type': 2, 'discount': 0.0,
          'observed_reward': 4.0,
          'senses/camera': [202, 203, 204, 205, 206, 207],
          'senses/codes': [2, -2], 'senses/time_left': 0.0,
          'registers/reward': 4.0, 'action': None,
      },
  ]  # fmt: skip
  first = table.to_pylist()[0]
  assert (first['discount'], first['observed_reward']) == (None, None)
  assert first['action'] == [0.25, -1.0]


def test_arrays_keep_their_types_and_shapes(tmp_path):
  table = _written(tmp_path, [made.stream()])
  for key, spec in made.stream().observation_spec.items():
    field = table.schema.field(key)
    shape = json.loads(field.metadata[b'shape'])
    assert shape == list(spec.shape)
    column = table.column(key).combine_chunks()
    flat = column.flatten() if spec.shape else column
    values = flat.to_numpy(zero_copy_only=False).reshape(3, *shape)
    assert values.dtype == spec.dtype
    expected = [one.observation[key] for one in made.stream().time_steps]
    np.testing.assert_array_equal(values, expected)
  action = table.schema.field('action')
  assert json.loads(action.metadata[b'names']) == ['forward', 'turn']
  assert json.loads(action.metadata[b'maximum']) == 1.0


def test_memory_is_bounded_by_groups_of_rows(tmp_path, monkeypatch):
  size = parquet.agent_table(made.stream(), 0).nbytes
  monkeypatch.setattr(parquet, '_MAX_BYTES', 2 * size)
  table = _written(tmp_path, [made.stream()] * 5)
  assert table.num_rows == 15
  file = pyarrow_parquet.ParquetFile(tmp_path / parquet.AGENT_FILE)
  groups = range(file.metadata.num_row_groups)
  assert [file.metadata.row_group(i).num_rows for i in groups] == [6, 6, 3]


def test_the_tables_of_the_evaluator_are_read_again(tmp_path):
  rows = truth.rows(made.episode(), 0)
  with parquet.appending(tmp_path) as append:
    for name, of_table in rows.items():
      table = parquet.truth_table(name, of_table)
      append(f'evaluator/{name}.parquet', table)
  for name, expected in rows.items():
    table = pyarrow_parquet.read_table(
        tmp_path / 'evaluator' / f'{name}.parquet'
    )
    for read, row in zip(table.to_pylist(), expected, strict=True):
      assert read == {**dict.fromkeys(table.schema.names), **row}
    metadata = table.schema.field('episode_id').metadata
    assert metadata == {
        b'description': b'Number of the episode in the dataset.'
    }

"""Parquet files of a dataset: one file for agents, and tables of the truth."""

from collections.abc import Mapping
import contextlib
import json
import pathlib
from typing import Any, final

from dm_env import specs as dm_env_specs
import numpy as np
import pyarrow as pa
from pyarrow import parquet

from realab_suite.datasets import columns
from realab_suite.datasets import recording
from realab_suite.datasets import truth
from realab_suite.experiments import storage

AGENT_FILE = 'agent/steps.parquet'
"""Path of the file for agents."""

_EVALUATOR = 'evaluator'
_SUFFIX = '.parquet'
# Rows are written when a table has this many, or this many bytes.
_MAX_ROWS = 1 << 16
_MAX_BYTES = 1 << 26


def agent_schema(agent: recording.AgentStream) -> pa.Schema:
  """Returns the schema of the file for agents.

  An array of the agent becomes a list of fixed size, in C order. Its shape is
  in the metadata of the field.

  Args:
    agent: Any episode of the file.
  """
  fields = [
      column
      for column in columns.AGENT
      if column.name != 'observed_reward' or agent.reward is not None
  ]
  fields += [
      _array_field(key, spec, nullable=False)
      for key, spec in agent.observation_spec.items()
  ]
  fields.append(_array_field('action', agent.action_spec, nullable=True))
  return pa.schema(fields)


def agent_table(agent: recording.AgentStream, episode_id: int) -> pa.Table:
  """Returns the rows of an episode in the file for agents.

  Args:
    agent: The part of the episode that the agent may see.
    episode_id: Number of the episode in the dataset.
  """
  time_steps = agent.time_steps
  layout = agent_schema(agent)
  number = len(time_steps)
  arrays: dict[str, pa.Array] = {
      'episode_id': pa.array(np.full(number, episode_id)),
      'step': pa.array(np.arange(number, dtype=np.int32)),
      'step_type': pa.array(
          np.array([int(one.step_type) for one in time_steps], np.int8)
      ),
      'discount': pa.array([one.discount for one in time_steps], pa.float64()),
  }
  if agent.reward is not None:
    readings = [float(one.observation[agent.reward]) for one in time_steps[1:]]
    arrays['observed_reward'] = pa.array([None, *readings], pa.float64())
  for key in agent.observation_spec:
    values = np.stack([one.observation[key] for one in time_steps])
    arrays[key] = _array(values, layout.field(key).type)
  # There is no action after the last time step.
  actions = _array(agent.actions, layout.field('action').type)
  missing = pa.nulls(1, layout.field('action').type)
  arrays['action'] = pa.concat_arrays([actions, missing])
  return pa.table([arrays[name] for name in layout.names], schema=layout)


def _array_field(
    name: str, spec: dm_env_specs.Array, nullable: bool
) -> pa.Field:
  kind = pa.from_numpy_dtype(spec.dtype)
  if spec.shape:
    kind = pa.list_(kind, int(np.prod(spec.shape)))
  metadata = {'shape': json.dumps(list(spec.shape))}
  if spec.name and name == 'action':
    metadata['names'] = json.dumps(spec.name.split('\t'))
  if isinstance(spec, dm_env_specs.BoundedArray):
    metadata['minimum'] = json.dumps(np.asarray(spec.minimum).tolist())
    metadata['maximum'] = json.dumps(np.asarray(spec.maximum).tolist())
  return pa.field(name, kind, nullable, metadata)


def _array(values: np.ndarray, kind: pa.DataType) -> pa.Array:
  """Returns an array with one element per row of values."""
  flat = pa.array(np.ascontiguousarray(values).reshape(-1))
  if not pa.types.is_fixed_size_list(kind):
    return flat.cast(kind)
  return pa.FixedSizeListArray.from_arrays(
      flat.cast(kind.value_type), type=kind
  )


@final
class _Table:
  """A Parquet file that grows; its rows are written in groups."""

  def __init__(self, path: pathlib.Path, layout: pa.Schema) -> None:
    self._path = path
    self._pending: list[pa.Table] = []
    with storage.explained(path):
      path.parent.mkdir(parents=True, exist_ok=True)
      self._writer = parquet.ParquetWriter(path, layout, compression='zstd')

  def add(self, table: pa.Table) -> None:
    """Appends rows.

    Raises:
      ResultsError: If they cannot be written.
    """
    self._pending.append(table)
    if (
        sum(one.num_rows for one in self._pending) >= _MAX_ROWS
        or sum(one.nbytes for one in self._pending) >= _MAX_BYTES
    ):
      self._flush()

  def close(self) -> None:
    """Writes the rest, and closes the file."""
    try:
      self._flush()
    finally:
      with storage.explained(self._path):
        self._writer.close()

  def _flush(self) -> None:
    if self._pending:
      rows = pa.concat_tables(self._pending)
      self._pending = []
      with storage.explained(self._path):
        self._writer.write_table(rows)


@final
class EvaluatorWriter:
  """Writes the tables of the truth, in the folder `evaluator`.

  Other users, who may run the agent, cannot read this folder. Use the writer as
  a context manager, which completes the files at its end.
  """

  def __init__(self, folder: pathlib.Path) -> None:
    """Creates the files.

    Args:
      folder: Folder of the dataset.

    Raises:
      ResultsError: If they cannot be created.
    """
    self._stack = contextlib.ExitStack()
    evaluator = folder / _EVALUATOR
    with storage.explained(evaluator):
      folder.mkdir(parents=True, exist_ok=True)
      evaluator.mkdir(mode=0o700)
    self._tables = {
        name: self._stack.enter_context(
            contextlib.closing(_Table(evaluator / f'{name}{_SUFFIX}', layout))
        )
        for name, layout in columns.EVALUATOR.items()
    }

  def add(self, rows: Mapping[str, list[truth.Row]]) -> None:
    """Appends the rows of an episode, as `truth.rows` returns them."""
    for name, table in self._tables.items():
      table.add(pa.Table.from_pylist(rows[name], columns.EVALUATOR[name]))

  def __enter__(self) -> 'EvaluatorWriter':
    return self

  def __exit__(self, *unused: Any) -> None:
    self._stack.close()


@final
class AgentWriter:
  """Writes the file for agents. Use it as a context manager."""

  def __init__(self, folder: pathlib.Path) -> None:
    """Makes a writer.

    Args:
      folder: Folder of the dataset.
    """
    self._path = folder / AGENT_FILE
    self._table: _Table | None = None

  def add(self, agent: recording.AgentStream, episode_id: int) -> None:
    """Appends an episode.

    Args:
      agent: The part of the episode that the agent may see.
      episode_id: Number of the episode in the dataset.
    """
    rows = agent_table(agent, episode_id)
    if self._table is None:
      self._table = _Table(self._path, rows.schema)
    self._table.add(rows)

  def __enter__(self) -> 'AgentWriter':
    return self

  def __exit__(self, *unused: Any) -> None:
    if self._table is not None:
      self._table.close()

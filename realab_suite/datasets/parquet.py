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
# Rows of a table are written when they have this many bytes.
_MAX_BYTES = 1 << 26


def agent_table(agent: recording.AgentStream, episode_id: int) -> pa.Table:
  """Returns the rows of an episode in the file for agents.

  An array of the agent becomes a list of fixed size, in C order. Its shape is
  in the metadata of the field.

  Args:
    agent: The part of the episode that the agent may see.
    episode_id: Number of the episode in the dataset.
  """
  time_steps = agent.time_steps
  values: dict[str, Any] = {
      'episode_id': [episode_id] * len(time_steps),
      'step': range(len(time_steps)),
      'step_type': [int(one.step_type) for one in time_steps],
      'discount': [one.discount for one in time_steps],
  }
  if agent.reward is not None:
    readings = [float(one.observation[agent.reward]) for one in time_steps[1:]]
    values['observed_reward'] = [None, *readings]
  fields = [columns.AGENT.field(name) for name in values]
  arrays = [pa.array(values[field.name], field.type) for field in fields]
  for key, spec in agent.observation_spec.items():
    fields.append(_array_field(key, spec, nullable=False))
    stacked = np.stack([one.observation[key] for one in time_steps])
    arrays.append(_array(stacked, fields[-1].type))
  fields.append(_array_field('action', agent.action_spec, nullable=True))
  kind = fields[-1].type
  # There is no action after the last time step.
  arrays.append(
      pa.concat_arrays([_array(agent.actions, kind), pa.nulls(1, kind)])
  )
  return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


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
class Writer:
  """Writes the tables of a dataset. Use it as a context manager.

  Other users, who may run the agent, cannot read the folder `evaluator`. Rows
  are written in groups; the files are complete when the context ends.
  """

  def __init__(self, folder: pathlib.Path) -> None:
    """Makes a writer.

    Args:
      folder: Folder of the dataset.

    Raises:
      ResultsError: If it cannot be written.
    """
    self._folder = folder
    self._stack = contextlib.ExitStack()
    self._files: dict[str, parquet.ParquetWriter] = {}
    self._pending: dict[str, list[pa.Table]] = {}
    evaluator = folder / _EVALUATOR
    with storage.explained(evaluator):
      folder.mkdir(parents=True, exist_ok=True)
      evaluator.mkdir(mode=0o700)

  def add(self, agent: recording.AgentStream, episode_id: int) -> None:
    """Appends an episode to the file for agents.

    Args:
      agent: The part of the episode that the agent may see.
      episode_id: Number of the episode in the dataset.

    Raises:
      ResultsError: If it cannot be written.
    """
    self._append(AGENT_FILE, agent_table(agent, episode_id))

  def add_truth(self, rows: Mapping[str, list[truth.Row]]) -> None:
    """Appends the rows of an episode, as `truth.rows` returns them.

    Raises:
      ResultsError: If they cannot be written.
    """
    for name, layout in columns.EVALUATOR.items():
      table = pa.Table.from_pylist(rows[name], layout)
      self._append(f'{_EVALUATOR}/{name}.parquet', table)

  def _append(self, name: str, table: pa.Table) -> None:
    if name not in self._files:
      path = self._folder / name
      with storage.explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = parquet.ParquetWriter(path, table.schema, compression='zstd')
      self._files[name] = self._stack.enter_context(file)
      self._stack.callback(self._flush, name)
    pending = self._pending.setdefault(name, [])
    pending.append(table)
    if sum(one.nbytes for one in pending) >= _MAX_BYTES:
      self._flush(name)

  def _flush(self, name: str) -> None:
    if pending := self._pending.pop(name, []):
      with storage.explained(self._folder / name):
        self._files[name].write_table(pa.concat_tables(pending))

  def __enter__(self) -> 'Writer':
    return self

  def __exit__(self, *unused: Any) -> None:
    with storage.explained(self._folder):
      self._stack.close()

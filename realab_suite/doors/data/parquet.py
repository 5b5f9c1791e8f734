"""Parquet files of a dataset: one file for agents, and tables of the truth."""

from collections.abc import Callable, Iterator
import contextlib
import pathlib
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from realab_suite.doors.data import columns
from realab_suite.doors.data import recording
from realab_suite.doors.data import truth
from realab_suite.lab.experiments import recorded_data
from realab_suite.lab.experiments import storage

AGENT_FILE = f'agent/{recorded_data.FILE}'
"""Path of the file for agents."""

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
    fields.append(recorded_data.array_field(key, spec))
    stacked = np.stack([one.observation[key] for one in time_steps])
    arrays.append(_array(stacked, fields[-1].type))
  fields.append(recorded_data.array_field('action', agent.action_spec))
  kind = fields[-1].type
  # There is no action after the last time step.
  arrays.append(
      pa.concat_arrays([_array(agent.actions, kind), pa.nulls(1, kind)])
  )
  return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _array(values: np.ndarray, kind: pa.DataType) -> pa.Array:
  """Returns an array with one element per row of values."""
  flat = pa.array(np.ascontiguousarray(values).reshape(-1))
  if not pa.types.is_fixed_size_list(kind):
    return flat.cast(kind)
  return pa.FixedSizeListArray.from_arrays(
      flat.cast(kind.value_type), type=kind
  )


def truth_table(name: str, rows: list[truth.Row]) -> pa.Table:
  """Returns rows of an episode as a table of the evaluator, by its name."""
  return pa.Table.from_pylist(rows, columns.EVALUATOR[name])


@contextlib.contextmanager
def appending(
    folder: pathlib.Path,
) -> Iterator[Callable[[str, pa.Table], None]]:
  """Yields a function that appends rows to a file with a path in a folder.

  Other users, who may run the agent, cannot read the folder `evaluator`. Rows
  are written in groups; the files are complete when the context ends.

  Args:
    folder: Folder of the dataset.

  Raises:
    ResultsError: If a file cannot be written.
  """
  files: dict[str, parquet.ParquetWriter] = {}
  pending: dict[str, list[pa.Table]] = {}

  def flush(name: str) -> None:
    with storage.explained(folder / name):
      files[name].write_table(pa.concat_tables(pending.pop(name)))

  def append(name: str, table: pa.Table) -> None:
    path = folder / name
    if name not in files:
      with storage.explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = parquet.ParquetWriter(path, table.schema, compression='zstd')
      files[name] = stack.enter_context(file)
    pending.setdefault(name, []).append(table)
    if sum(one.nbytes for one in pending[name]) >= _MAX_BYTES:
      flush(name)

  with storage.explained(folder), contextlib.ExitStack() as stack:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'evaluator').mkdir(mode=0o700)
    yield append
    for name in list(pending):
      flush(name)

"""Files of published results: tables in Parquet, and one JSON file.

A record is plain data: mappings of mappings of numbers and texts. A table has a
column for each of its leaves, named by the keys on the way: the corruption of
the register `reward` is `registers/reward/corruption`. Keys that contain a
slash or a tilde are escaped as in JSON pointers (RFC 6901).
"""

from collections.abc import Iterable, Mapping, Sequence
import math
import pathlib
from typing import Any, Final

import pyarrow as pa
from pyarrow import parquet

from realab_suite import errors
from realab_suite.lab.experiments import storage

ROWS: Final = 'rows.parquet'
"""Evaluation episodes."""
CURVES: Final = 'curves.parquet'
"""Points of learning curves."""
GAINS: Final = 'training_gains.parquet'
"""Numbers of training episodes with equal gains."""
TABLES: Final = ROWS, CURVES, GAINS

# Floats that are texts in JSON.
_NOT_FINITE = {'NaN': math.nan, 'Infinity': math.inf, '-Infinity': -math.inf}


def write_table(
    path: pathlib.Path, records: Sequence[Mapping[str, Any]]
) -> None:
  """Writes a table of records; the same records give the same bytes.

  Leaves that are `None` are empty cells, and columns without any other cell are
  left out.

  Args:
    path: Path of the file.
    records: The records, in order.

  Raises:
    ResultsError: If a column has values of several types, or the file cannot be
      written.
  """
  rows = [dict(_leaves(record)) for record in records]
  names = dict.fromkeys(name for row in rows for name in row)
  columns = {name: [row.get(name) for row in rows] for name in names}
  try:
    arrays = {name: pa.array(values) for name, values in columns.items()}
  except (pa.ArrowException, OverflowError) as error:
    raise errors.ResultsError(f'{path}: {error}') from error
  table = pa.table(
      {
          name: array
          for name, array in arrays.items()
          if not pa.types.is_null(array.type)
      }
  )
  sink = pa.BufferOutputStream()
  parquet.write_table(
      table, sink, compression='zstd', compression_level=19, version='2.6'
  )
  storage.write_whole(path, sink.getvalue().to_pybytes())


def read_table(path: pathlib.Path) -> list[dict[str, Any]]:
  """Returns the rows of a table: the leaves of its records by name.

  Empty cells are `None`.

  Raises:
    ResultsError: If the file cannot be read.
  """
  with storage.fitting(path):
    data = pa.BufferReader(path.read_bytes())
    rows: list[dict[str, Any]] = parquet.read_table(data).to_pylist()
    for leaves in rows[:1]:
      nested(leaves)
  return rows


def nested(leaves: Mapping[str, Any]) -> dict[str, Any]:
  """Returns the record of some leaves, by their names."""
  record: dict[str, Any] = {}
  for name, value in leaves.items():
    *parents, key = (
        part.replace('~1', '/').replace('~0', '~') for part in name.split('/')
    )
    inner = record
    for parent in parents:
      inner = inner.setdefault(parent, {})
    inner[key] = value
  return record


def _leaves(
    record: Mapping[str, Any], prefix: str = ''
) -> Iterable[tuple[str, Any]]:
  for key, value in record.items():
    name = prefix + key.replace('~', '~0').replace('/', '~1')
    if isinstance(value, Mapping):
      yield from _leaves(value, f'{name}/')
    else:
      yield name, _NOT_FINITE.get(value, value) if prefix else value

"""Cards of datasets: a README with the contents, the origin and the columns."""

from collections.abc import Iterator, Sequence
import math
import pathlib
from typing import Any

import pandas as pd
import pyarrow as pa

from realab_suite.doors.data import columns
from realab_suite.evaluation import results
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import tables

NAME = 'README.md'
"""Name of the file."""

_HEAD = """# Episodes of realab_suite

The feedback of the agent is stored in physical registers, which it can corrupt.
An agent, or a monitor in its place, may read {agents} and nothing else. The
other files contain the truth: true rewards, writes, clean contents, corruption
by kind, and the label `is_tampering` of each step (missing where the learner is
not judged, and where the stake is unknown or degenerate).

Every episode was replayed from its recorded actions, and its returns and its
corruption are those of the evaluation. Files are joined on `episode_id` and
`step`; true columns never stand in a file for agents.
"""
_COUNTS = (
    'run',
    'policy',
    'design',
    'channel',
    'episodes',
    'steps',
    'tampering steps',
    'mean relative gain',
    'mean true return',
    'mean observed return',
)
_MINARI = (
    'The data of the agent are a Minari dataset: `{name}`, with'
    ' `MINARI_DATASETS_PATH` set to the folder `agent`. Its rewards are'
    ' observed rewards.'
)


def write(
    folder: pathlib.Path,
    groups: Sequence[tuple[str, Sequence[dict[str, Any]]]],
    data_format: str,
) -> None:
  """Writes the card of a dataset.

  Args:
    folder: Folder of the dataset.
    groups: Folder with the data of the agent, and rows of the table of
      episodes, of each group.
    data_format: As in `export.export`.
  """
  everything = [row for _, rows in groups for row in rows]
  parts = [
      _HEAD.format(agents=', '.join(f'`{name}/`' for name, _ in groups)),
      '## Contents\n\n' + tables.markdown([_COUNTS, *_counts(everything)]),
      '## Versions\n\n'
      + tables.markdown([('package', 'version'), *results.versions().items()]),
      '## Columns\n',
  ]
  if data_format == 'minari':
    parts.append(_MINARI.format(name=_minari_name(folder)))
  else:
    parts.append('### agent/steps.parquet\n\n' + table_of(columns.AGENT))
    parts.append(
        'Then one column for each entry of the observations, such as'
        ' `senses/position` or `registers/reward`, and `action`, which is'
        ' missing in the last step. Arrays are lists of fixed size in C order;'
        ' the metadata of each field contain the shape, and of `action` the'
        ' names and the bounds.'
    )
  for name, table in columns.EVALUATOR.items():
    parts.append(f'### evaluator/{name}.parquet\n\n{table_of(table)}')
  text = '\n\n'.join(part.strip('\n') for part in parts)
  path = folder / NAME
  storage.write_whole(path, f'{text}\n'.encode())
  with storage.explained(path):
    path.chmod(0o600)  # It summarises the tables of the evaluator.


def table_of(table: pa.Schema) -> str:
  """Returns columns as a table in Markdown."""
  columns_of = [
      (
          f'`{one.name}`',
          str(one.type),
          one.metadata.get(b'unit', b'-').decode(),
          one.metadata[b'description'].decode(),
      )
      for one in table
  ]
  return tables.markdown([('column', 'type', 'unit', 'meaning'), *columns_of])


def _counts(episodes: Sequence[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
  """Yields a row of the table of contents for each run, policy and design."""
  frame = pd.DataFrame(episodes)
  for key, rows in frame.groupby(['run', 'policy', 'design', 'channel']):
    labels = rows['num_tampering_steps'].dropna()
    missing = len(rows) - len(labels)
    note = f' ({missing} episodes without labels)' if missing else ''
    means = rows[['relative_gain', 'true_return', 'observed_return']]
    yield (
        *key,
        len(rows),
        int(rows['num_steps'].sum()),
        f'{labels.sum():.0f}{note}' if len(labels) else None,
        *(
            None if math.isnan(mean) else f'{mean:.2f}'
            for mean in means.astype(float).mean()
        ),
    )


def _minari_name(folder: pathlib.Path) -> str:
  """Returns the name of the Minari dataset in a folder."""
  [data] = (folder / 'agent').glob('**/data')
  return data.parent.relative_to(folder / 'agent').as_posix()

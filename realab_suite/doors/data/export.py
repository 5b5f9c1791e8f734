"""Exports of runs, and labelled datasets of several runs.

    sweep = studies.read_sweep(pathlib.Path('results/paper'))
    source = sources.of_run(sweep.runs['reward'], num_episodes=20)
    export.export(source, pathlib.Path('results/data'), data_format='parquet')

`docs/doors.md` describes the files.
"""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import os
import pathlib
import tempfile
from typing import Any, Final

import numpy as np

from realab_suite import errors
from realab_suite.doors.data import recording
from realab_suite.doors.data import sources
from realab_suite.doors.data import truth
from realab_suite.lab.experiments import recorded_data
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import storage

FORMATS: Final = ('parquet', 'minari')
"""Formats of the agent's data. The evaluator's tables are always Parquet."""

_AGENT = 'agent'


def export(
    source: sources.Source,
    output: pathlib.Path,
    *,
    data_format: str = 'parquet',
    say: Callable[[str], None] = lambda line: None,
) -> pathlib.Path:
  """Writes the episodes of a run into a new folder.

  Episodes are numbered in the order of the source.

  Args:
    source: The run.
    output: New folder. It appears only when it is complete.
    data_format: Format of the agent's data: 'parquet' or 'minari'.
    say: Called with messages for the user.

  Returns:
    The folder.

  Raises:
    SpecError: If the format does not exist.
    ResultsError: If a package is missing, the folder exists or cannot be
      written, or a replay differs from the results.
  """
  check(data_format, output)
  from realab_suite.doors.data import cards  # Imports pyarrow.

  with _new_folder(output) as folder:
    episodes = _written(source, folder, data_format, say)
    cards.write(folder, [(_AGENT, episodes)], data_format)
  return output


def labelled(
    of_all: Sequence[sources.Source],
    output: pathlib.Path,
    say: Callable[[str], None] = lambda line: None,
) -> pathlib.Path:
  """Writes a labelled dataset of tampering into a new folder.

  Each group of sources (see `grouped`) becomes a subfolder with the files of an
  export. Its episodes are shuffled with a fixed seed, so neither the number of
  an episode nor its position in the agent's file reveals its run.

  Args:
    of_all: The sources.
    output: New folder. It appears only when it is complete.
    say: Called with messages for the user.

  Returns:
    The folder.

  Raises:
    ResultsError: As in `export`.
  """
  check('parquet', output)
  from realab_suite.doors.data import cards  # Imports pyarrow.

  with _new_folder(output) as folder:
    written = []
    for name, of_group in grouped(of_all):
      planned = [one for source in of_group for one in source]
      order = np.random.default_rng(0).permutation(len(planned))
      shuffled = [planned[i] for i in order]
      episodes = _written(shuffled, folder / name, 'parquet', say)
      written.append((f'{name}/{_AGENT}', episodes))
    cards.write(folder, written, 'parquet')
  return output


def grouped(
    of_all: Sequence[sources.Source],
) -> list[tuple[str, list[sources.Source]]]:
  """Returns groups of sources with the same design, observations and actions.

  A second group of a design has a name that ends with a number.

  Args:
    of_all: The sources.
  """
  by_kind: dict[tuple[str, str], list[sources.Source]] = {}
  for source in of_all:
    key = source[0].design.name, recording.kind_of(source[0])
    by_kind.setdefault(key, []).append(source)
  groups = []
  counts: dict[str, int] = {}
  for (name, _), of_group in by_kind.items():
    counts[name] = counts.get(name, 0) + 1
    number = f'_{counts[name]}' if counts[name] > 1 else ''
    groups.append((f'{name}{number}', of_group))
  return groups


def check(data_format: str, output: pathlib.Path) -> None:
  """Checks everything that can be checked before any work.

  Raises:
    SpecError: If the format does not exist.
    ResultsError: If a package is missing or the folder exists.
  """
  if data_format not in FORMATS:
    raise errors.SpecError(
        f'format: {data_format!r:.80}; must be one of {list(FORMATS)}'
    )
  needed = ['pyarrow']
  if data_format == 'minari':
    needed += ['minari', 'h5py', 'gymnasium', 'PIL']
  if problem := requirements.missing(*needed, extra='data'):
    raise errors.ResultsError(f'cannot export: {problem}')
  with storage.explained(output):
    if output.exists() or output.is_symlink():
      raise errors.ResultsError(
          f'{output}: exists, and datasets are never overwritten; name a new'
          ' folder'
      )


@contextlib.contextmanager
def _new_folder(output: pathlib.Path) -> Iterator[pathlib.Path]:
  """Yields a temporary folder that becomes the output if nothing fails."""
  with contextlib.ExitStack() as stack:
    with storage.explained(output):
      output.parent.mkdir(parents=True, exist_ok=True)
      temporary = stack.enter_context(
          tempfile.TemporaryDirectory(prefix='.export-', dir=output.parent)
      )
    folder = pathlib.Path(temporary) / 'dataset'
    with storage.explained(output):
      folder.mkdir()
    yield folder
    with storage.explained(output):
      os.rename(folder, output)


def _write_manifest(
    folder: pathlib.Path,
    planned: Sequence[replays.Recorded],
    episodes: Sequence[truth.Row],
) -> None:
  """Writes where the data of the agent are from, for `recorded_data` alone."""
  origins: list[dict[str, Any]] = []
  for one in planned:
    origin = recorded_data.origin(one.world, one.design)
    if origin not in origins:
      origins.append(origin)
  file = recorded_data.FILE
  num_steps = sum(row['num_steps'] + 1 for row in episodes)
  content = {
      'policies': sorted({row['policy'] for row in episodes}),
      'origins': origins,
      storage.FILES: {file: storage.imprint(folder / _AGENT / file, num_steps)},
  }
  path = folder / recorded_data.MANIFEST
  storage.write_json(path, content)
  with storage.explained(path):
    path.chmod(0o600)  # Agents must not read it.


def _written(
    planned: Sequence[replays.Recorded],
    folder: pathlib.Path,
    data_format: str,
    say: Callable[[str], None],
) -> list[truth.Row]:
  """Writes episodes, and returns their rows in the table of episodes."""
  from realab_suite.doors.data import parquet  # Imports pyarrow.

  episodes: list[truth.Row] = []
  with parquet.appending(folder) as append:

    def agents() -> Iterator[recording.AgentStream]:
      """Writes the truth of each episode, and yields the agent's part."""
      for episode_id, recorded in enumerate(planned):
        episode = recording.record(recorded)
        rows = truth.rows(episode, episode_id)
        for name, of_table in rows.items():
          table = parquet.truth_table(name, of_table)
          append(f'evaluator/{name}.parquet', table)
        episodes.extend(rows['episodes'])
        yield episode.agent

    if data_format == 'minari':
      from realab_suite.doors.data import minari_export  # Imports minari.

      info = planned[0].row.info
      name = minari_export.dataset_id((info.domain, info.task), info.run)
      minari_export.write(folder / _AGENT, name, agents())
    else:
      for episode_id, agent in enumerate(agents()):
        append(parquet.AGENT_FILE, parquet.agent_table(agent, episode_id))
  if data_format == 'parquet':
    _write_manifest(folder, planned, episodes)
  say(f'{len(episodes)} episodes were written')
  return episodes

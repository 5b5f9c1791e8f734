"""Campaign C36: a run that is killed at any operation ends like any other.

Run from the root of the repository, about ten minutes:

    python -m campaigns.kill_campaign [scale] [seed]

A run does some sixty operations on files: writes, truncations, fsyncs, renames
and removals. It is killed at the first of them, at the second, and so on until
it is through; each time in four ways: before the operation, half way through
a write, and by a loss of power, which takes back all that was not synchronised,
with the new names of files or without. Then it is killed at 300 random times,
some of them again while it goes on. Afterwards it is started again, and its
results and last checkpoints have to be those of a run that nobody killed, byte
for byte. What a run of scripted policies has said of rows holds, too: none that
was acknowledged is lost, and what is left of one that was being written is said
to be torn.

The learner is a fake that costs nothing; `resume_campaign` has a real one. The
first argument is the share of all this to do, the second the seed.
"""

from collections.abc import Sequence
import dataclasses
import os
import pathlib
import signal
import tempfile
import time
from typing import Any, final
import warnings

import numpy as np
import yaml

from campaigns import figure_lines
from campaigns import victims
from campaigns import zygote
from realab_suite.evaluation import results
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import training

RANDOM_KILLS = 300
_MOST_TRIES = 10  # For each that hits.


@final
@dataclasses.dataclass
class Tally:
  """What became of runs that were killed.

  Attributes:
    kills: How many times one was.
    random_kills: How many of these were at random times.
    failures: What runs said that could not go on, or ended otherwise.
    differing: The files that differ from those of the run that was not killed.
  """

  kills: int = 0
  random_kills: int = 0
  failures: list[str] = dataclasses.field(default_factory=list)
  differing: list[str] = dataclasses.field(default_factory=list)


@final
class Killer:
  """Starts runs, kills them, and has them go on."""

  def __init__(self, nursery: zygote.Zygote, root: pathlib.Path) -> None:
    """Does the run once, without killing it."""
    self._nursery = nursery
    self._root = root
    self._experiment = root / 'experiment.yaml'
    self._experiment.write_text(yaml.safe_dump(victims.EXPERIMENT))
    [self.job] = jobs.plan(experiment_specs.load(self._experiment))
    count = root / 'count'
    for name in ('first', 'whole'):
      # The first one imports what the others find there.
      began = time.monotonic()
      ended = self.train(root / name, count=str(count))
      self.seconds = time.monotonic() - began
      if ended.status:
        raise RuntimeError(f'a run that nobody killed has failed: {ended.said}')
    self.num_operations = int(count.read_text())
    self.whole_folder = root / 'whole' / self.job.folder()
    self._whole = self._results(root / 'whole')
    self._num_outputs = 0
    self.tally = Tally()

  def train(self, output: pathlib.Path, **options: Any) -> zygote.Ended:
    """Starts a run, or goes on with it, and waits for its end."""
    return self._nursery.wait(self._start(output, **options))

  def kill_at(self, number: int, way: str, bug: str | None = None) -> None:
    """Kills a run at one of its operations, then lets it go on."""
    output = self._new_output()
    ended = self.train(output, die_at=number, way=way, bug=bug)
    if ended.status == -signal.SIGKILL:
      self.tally.kills += 1
    else:
      self.tally.failures.append(f'not killed: {ended}')
    self.finish(output, f'operation {number}, {way}', bug)

  def kill_at_random(self, rng: np.random.Generator) -> None:
    """Kills a run at a random time, perhaps again, then lets it go on."""
    output = self._new_output()
    for _ in range(rng.integers(1, 4)):
      pid = self._start(output)
      time.sleep(rng.uniform(0.0, self.seconds))
      os.kill(pid, signal.SIGKILL)
      was_killed = self._nursery.wait(pid).status == -signal.SIGKILL
      self.tally.kills += was_killed
      self.tally.random_kills += was_killed
    self.finish(output, 'at random')

  def finish(
      self, output: pathlib.Path, what: str, bug: str | None = None
  ) -> None:
    """Lets a run go on to its end, and compares its results."""
    ended = self.train(output, bug=bug)
    if ended.status:
      self.tally.failures.append(f'{what}: {ended.said.splitlines()[-1:]}')
      return
    found = self._results(output)
    self.tally.differing += [
        f'{what}: {name}'
        for name in sorted(found.keys() | self._whole.keys())
        if found.get(name) != self._whole.get(name)
    ]

  def _start(self, output: pathlib.Path, **options: Any) -> int:
    return self._nursery.start(
        'run_training',
        experiment=str(self._experiment),
        output=str(output),
        **options,
    )

  def _new_output(self) -> pathlib.Path:
    self._num_outputs += 1
    return self._root / str(self._num_outputs)

  def _results(self, output: pathlib.Path) -> dict[str, bytes]:
    folder = output / self.job.folder()
    kept = sorted((folder / victims.KEPT).iterdir())
    paths = [*(folder / name for name in victims.NAMES), *kept]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@final
@dataclasses.dataclass
class RowTally:
  """What became of rows whose writer was killed.

  Attributes:
    kills: How many times it was.
    acknowledged: How many rows it had acknowledged.
    lost: How many of them could not be read, or were other ones.
    torn: How often there was a part of a row.
    unnoticed: How often nothing was said of it.
  """

  kills: int = 0
  acknowledged: int = 0
  lost: int = 0
  torn: int = 0
  unnoticed: int = 0


def kill_writer(
    nursery: zygote.Zygote,
    root: pathlib.Path,
    rows: Sequence[results.EpisodeRow],
    number: int,
    way: str,
    tally: RowTally,
) -> None:
  """Kills whoever writes rows at one operation, and reads what is there."""
  path, said = root / f'rows-{number}-{way}', root / f'said-{number}-{way}'
  ended = nursery.call(
      'write_rows',
      path=str(path),
      acknowledged=str(said),
      rows=[row.model_dump_json(by_alias=True) for row in rows],
      die_at=number,
      way=way,
  )
  if ended.status != -signal.SIGKILL:
    raise RuntimeError(f'a writer was not killed: {ended}')
  tally.kills += 1
  acknowledged = said.stat().st_size
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    found = list(results.read_rows(path))
  data = path.read_bytes()
  is_torn = bool(data) and not data.endswith(b'\n')
  tally.acknowledged += acknowledged
  tally.lost += found != list(rows[: len(found)]) or len(found) < acknowledged
  tally.torn += is_torn
  tally.unnoticed += is_torn and len(caught) != 1


def rows_of(killer: Killer, count: int) -> list[results.EpisodeRow]:
  """Returns rows such as runs write, each of another episode."""
  [row, *_] = results.read_rows(killer.whole_folder / training.EPISODES)
  return [row.model_copy(update={'episode': i}) for i in range(count)]


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  rng = np.random.default_rng(seed)
  lines = figure_lines.Lines('C36', seed)
  with (
      tempfile.TemporaryDirectory() as folder,
      zygote.Zygote(victims.__name__) as nursery,
  ):
    root = pathlib.Path(folder)
    killer = Killer(nursery, root)
    points = [
        (number, way)
        for number in range(1, killer.num_operations + 1)
        for way in victims.WAYS
    ]
    count = max(round(scale * len(points)), 1)
    # Some of every kind, evenly from first to last.
    for i in np.linspace(0, len(points) - 1, count).round().astype(int):
      killer.kill_at(*points[i])
    tally = killer.tally
    lines.at_least('kills at operations', tally.kills, 0.5 * count)
    wanted = round(scale * RANDOM_KILLS)
    for _ in range(_MOST_TRIES * wanted):
      if tally.random_kills < wanted:
        killer.kill_at_random(rng)
    lines.at_least('kills at random times', tally.random_kills, wanted)
    lines.at_most('runs that did not go on', len(tally.failures), 0)
    lines.at_most('files that differ', len(tally.differing), 0)
    for complaint in (*tally.failures, *tally.differing):
      print(f'  {complaint}')
    rows = rows_of(killer, 8)
    written = RowTally()
    for number in range(1, 2 * len(rows) + 1):
      for way in victims.WAYS:
        kill_writer(nursery, root, rows, number, way, written)
    lines.at_least('acknowledged rows', written.acknowledged, 1)
    lines.at_least('torn rows', written.torn, 1)
    lines.at_most('acknowledged rows lost', written.lost, 0)
    lines.at_most('torn rows that nothing is said of', written.unnoticed, 0)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)

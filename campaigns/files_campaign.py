"""Campaign C23: no damaged file is taken for what was written.

Run from the root of the repository, about two minutes:

    python -m campaigns.files_campaign

Every kind of file that this package reads back is written, damaged and read:
bits are flipped, the end is cut off, blocks are zeroed, bytes go missing or are
there twice, and files take each other's place. What is read has to be refused
with an error of this package, or be what was written (as where only white space
has changed). No byte may reach a pickle. Prints `C23 figure target verdict
seed`. Arguments are the scale and the seed.
"""

from collections.abc import Callable
import json
import pathlib
import sys
import tempfile
from typing import Any, NamedTuple
import warnings

import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.evaluation import incentives
from realab_suite.evaluation import results
from realab_suite.experiments import probes
from realab_suite.experiments import scheduler
from realab_suite.experiments import served_run
from realab_suite.experiments import storage
from realab_suite.experiments import training
from realab_suite.policies import network_files
from realab_suite.reports import sweep_results
from tests.experiments import fake_sweep
from tests.experiments import small

NUM_DAMAGED = 5_000
# Python's events of a pickle that is read, and of what one may do.
_FORBIDDEN = ('pickle.find_class', 'marshal.loads', 'os.system')
_HEADER = {'configuration': '0123456789ab', 'what': 'checkpoint'}


class Kind(NamedTuple):
  """A kind of file.

  Attributes:
    name: What it is called.
    path: Where one is.
    read: Returns what it says, as something that can be compared.
  """

  name: str
  path: pathlib.Path
  read: Callable[[], Any]


class Events:
  """Counts audit events of code that a file should not be able to run."""

  def __init__(self) -> None:
    self.heard: list[str] = []
    self._is_on = False
    sys.addaudithook(self._hear)  # Stays for as long as the process.

  def __enter__(self) -> 'Events':
    self.heard.clear()
    self._is_on = True
    return self

  def __exit__(self, *unused: Any) -> None:
    self._is_on = False

  def _hear(self, event: str, arguments: Any) -> None:
    if self._is_on and event in _FORBIDDEN:
      self.heard.append(event)


def _plain(value: Any) -> Any:
  """Returns a tree as something whose `repr` says all of it."""
  if isinstance(value, np.ndarray):
    return value.dtype.str, value.shape, value.tobytes()
  if isinstance(value, dict):
    return {key: _plain(item) for key, item in value.items()}
  if isinstance(value, list | tuple):
    return [_plain(item) for item in value]
  return value


def _of_snapshot(path: pathlib.Path, header: dict[str, Any]) -> Any:
  snapshot = snapshots.Snapshot.from_bytes(path.read_bytes())
  return _plain(snapshot.contents_for(header))


def _of_rows(path: pathlib.Path) -> Any:
  with warnings.catch_warnings():
    # A torn end is left out, and said so: nothing was taken for what it is not.
    warnings.simplefilter('error')
    try:
      return [row.model_dump_json() for row in results.read_rows(path)]
    except UserWarning as warning:
      raise errors.ResultsError(str(warning)) from warning


def build(folder: pathlib.Path) -> list[Kind]:
  """Writes one file of each kind."""
  sweep = fake_sweep.build(folder / 'sweep', fake_sweep.experiment(seeds=[0]))
  [job] = [
      one
      for one in json.loads((sweep / scheduler.SWEEP).read_text())['jobs']
      if one['run'] == 'reward'
  ]
  run = sweep / job['folder']
  checkpoints = storage.RunFolder(folder / 'run', {'seed': 0})
  state = {
      'weights': np.arange(600.0).reshape(20, 30), 'done': 7, 'nothing': None,
      'names': ['a', 'b'], 'pair': (1, 2.5),
  }  # fmt: skip
  checkpoints.save(100, _HEADER, state)
  checkpoints.close()
  (checkpoint,) = (folder / 'run' / 'checkpoints').iterdir()
  learner = folder / training.LEARNER
  header = {**_HEADER, 'what': training.LEARNER}
  storage.write_archive(learner, header, state)
  env = suite.load('collect_apples', 'standard', {'random': 0})
  env.reset()
  world = folder / 'world.snapshot'
  world.write_bytes(env.save().to_bytes())
  world_header = env.snapshot_header()
  env.close()
  probes.save(folder, _probe())
  network = folder / 'net.npz'
  network.write_bytes(network_files.load('demonstrator_v1').to_bytes())
  record = small.write_served_run(folder)

  def load_checkpoint() -> Any:
    with storage.RunFolder(folder / 'run', {'seed': 0}) as opened:
      return _plain(opened.load(_HEADER))

  def load_record() -> Any:
    loaded = served_run.read(str(record))
    return loaded, loaded.salt

  def load_learner() -> Any:
    return _plain(storage.read_archive(learner, header))

  def load_network() -> Any:
    loaded = network_files.load(network)
    return loaded.digest()

  def load_probe() -> Any:
    probe = probes.load(folder)
    assert probe is not None
    return _plain(vars(probe) | {'probabilities': dict(probe.probabilities)})

  def load_sweep() -> Any:
    loaded = sweep_results.load(sweep)
    return loaded.experiment, [
        (run.name, run.jobs, [*map(results.line, run.rows)], run.configs)
        for run in loaded.runs.values()
    ]

  def load_done() -> Any:
    return storage.is_done(run), load_sweep()

  def of_done(name: str) -> Any:
    return load_done(), (run / name).read_bytes()

  return [
      Kind('checkpoint', checkpoint, load_checkpoint),
      Kind('learner.bin', learner, load_learner),
      Kind('snapshot', world, lambda: _of_snapshot(world, world_header)),
      Kind('trace.bin', run / training.TRACE, lambda: of_done(training.TRACE)),
      Kind('network', network, load_network),
      Kind('probe.bin', folder / probes.PROBE, load_probe),
      Kind('sweep.json', sweep / scheduler.SWEEP, load_sweep),
      Kind('experiment.yaml', sweep / scheduler.EXPERIMENT, load_sweep),
      Kind('done.json', run / storage.DONE, load_done),
      Kind('config.json', run / storage.CONFIG, load_sweep),
      Kind(
          'episodes.jsonl',
          run / training.EPISODES,
          lambda: _of_rows(run / training.EPISODES),
      ),
      Kind(
          'curve.jsonl', run / training.CURVE, lambda: of_done(training.CURVE)
      ),
      Kind('run.json', record, load_record),
  ]


def _probe() -> incentives.Probe:
  rng = np.random.default_rng(0)
  return incentives.Probe(
      register='reward',
      scale=0.1,
      corruption=rng.normal(size=(3, 4)),
      offset=rng.normal(size=3),
      probabilities={'learner': np.full((3, 4), 0.25)},
  )


def damaged(
    data: bytes, others: list[bytes], rng: np.random.Generator
) -> tuple[str, bytes]:
  """Returns a kind of damage, and what it makes of a file."""
  how = ('flip', 'flip', 'flip', 'cut', 'zero', 'lose', 'twice', 'swap')[
      int(rng.integers(8))
  ]
  where = int(rng.integers(len(data)))
  length = int(rng.integers(1, 1 + min(512, len(data))))
  if how == 'flip':
    flipped = bytearray(data)
    flipped[where] ^= 1 << int(rng.integers(8))
    return how, bytes(flipped)
  if how == 'cut':
    return how, data[:where]
  if how == 'zero':
    blank = data[where : where + length]
    return how, data[:where] + bytes(len(blank)) + data[where + length :]
  if how == 'lose':
    return how, data[:where] + data[where + length :]
  if how == 'twice':
    return how, data[: where + length] + data[where:]
  return how, others[int(rng.integers(len(others)))]


class Figures(NamedTuple):
  """What came of damage to one kind of file."""

  tried: int
  refused: int
  undetected: int
  other_errors: int
  unclear: int
  first: str


def judge(
    kind: Kind, others: list[bytes], number: int, rng: np.random.Generator
) -> Figures:
  """Damages a file again and again, and reads it."""
  whole = kind.path.read_bytes()
  expected = repr(kind.read())
  counts = dict.fromkeys(
      ('refused', 'undetected', 'other_errors', 'unclear'), 0
  )
  first = ''
  for _ in range(number):
    how, data = damaged(whole, others, rng)
    kind.path.write_bytes(data)
    problem = ''
    try:
      if repr(kind.read()) != expected:
        counts['undetected'] += 1
        problem = 'undetected'
    except errors.RealabError as error:
      counts['refused'] += 1
      # Names of checkpoints and such come with errors of whoever reads a path.
      if len(str(error).splitlines()) != 1 or len(str(error)) > 2_000:
        counts['unclear'] += 1
        problem = f'unclear: {error!s:.300}'
    except Exception as error:
      counts['other_errors'] += 1
      problem = f'{type(error).__name__}: {error!s:.200}'
    if problem and not first:
      first = f'{kind.name}, {how}: {problem}'
  kind.path.write_bytes(whole)
  assert repr(kind.read()) == expected
  return Figures(number, **counts, first=first)


def run(number: int, seed: int, events: Events) -> dict[str, Figures]:
  """Damages every kind of file; returns figures by kind."""
  rng = np.random.default_rng(seed)
  found = {}
  with tempfile.TemporaryDirectory() as name:
    kinds = build(pathlib.Path(name))
    contents = {kind.name: kind.path.read_bytes() for kind in kinds}
    for kind in kinds:
      others = [data for other, data in contents.items() if other != kind.name]
      with events:
        found[kind.name] = judge(kind, others, number // len(kinds) + 1, rng)
  return found


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C23', seed)
  events = Events()
  found = run(round(scale * NUM_DAMAGED), seed, events)
  for name, figures in found.items():
    lines.at_least(f'{name}: refused', figures.refused, 0.7 * figures.tried)
    lines.at_most(f'{name}: undetected', figures.undetected, 0)
    bad = figures.other_errors + figures.unclear
    lines.at_most(f'{name}: other errors, or unclear ones', bad, 0)
    if figures.first:
      print(figures.first, file=sys.stderr)
  lines.at_most('events of pickles', len(events.heard), 0)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)

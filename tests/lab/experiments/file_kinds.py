"""Files of every kind that this package writes and reads back."""

from collections.abc import Callable
import json
import pathlib
from typing import Any, NamedTuple

import numpy as np

from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.evaluation import results
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_results
from realab_suite.lab.experiments import training
from realab_suite.policies import network_files
from tests.lab.experiments import fake_sweep

_HEADER = {'configuration': '0123456789ab', 'what': 'checkpoint'}


class Kind(NamedTuple):
  """A kind of file.

  Attributes:
    name: Name of the kind.
    path: A file of this kind.
    read: Reads the file; the `repr` of its result contains all of it.
  """

  name: str
  path: pathlib.Path
  read: Callable[[], Any]


def _plain(value: Any) -> Any:
  """Returns a tree whose `repr` contains all of it."""
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


def build(folder: pathlib.Path) -> list[Kind]:
  """Writes one file of each kind that this package reads back."""
  sweep = fake_sweep.build(folder / 'sweep', fake_sweep.experiment(seeds=[0]))
  [job] = [
      one
      for one in json.loads((sweep / scheduler.SWEEP).read_text())['jobs']
      if one['run'] == 'reward'
  ]
  run = sweep / job['folder']
  (folder / 'run').mkdir()
  checkpoints = storage.RunFolder(folder / 'run', {'seed': 0})
  state = {
      'weights': np.arange(600.0).reshape(20, 30), 'done': 7, 'nothing': None,
      'names': ['a', 'b'], 'pair': (1, 2.5),
  }  # fmt: skip
  checkpoints.save(100, _HEADER, state)
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
  network = folder / 'net.npz'
  network.write_bytes(network_files.load('demonstrator_v1').to_bytes())

  def load_checkpoint() -> Any:
    opened = storage.RunFolder(folder / 'run', {'seed': 0})
    return _plain(opened.load(_HEADER))

  def load_learner() -> Any:
    return _plain(storage.read_archive(learner, header))

  def load_network() -> Any:
    loaded = network_files.load(network)
    return loaded.digest()

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
      Kind('config.json', run / storage.CONFIG, load_sweep),
      Kind(
          'episodes.jsonl',
          run / training.EPISODES,
          lambda: of_done(training.EPISODES),
      ),
      Kind(
          'curve.jsonl', run / training.CURVE, lambda: of_done(training.CURVE)
      ),
  ]

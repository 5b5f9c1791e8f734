"""Tests for damaged files: they are refused, and run no code."""

from collections.abc import Callable, Iterator
import contextlib
import json
import pathlib
import pickle
import sys
from typing import Any, NamedTuple

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import snapshots
from realab_suite.evaluation import results
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import training
from realab_suite.policies import network_files
from tests import damage
from tests import examples
from tests.lab.experiments import fake_sweep

_NAMES = (
    'checkpoint', 'snapshot', 'network', 'trace.bin', 'config.json',
)  # fmt: skip
# Audit events of a pickle that is read, and of a command that one may run.
_FORBIDDEN = ('pickle.find_class', 'os.system')
_HEARD: list[str] = []
_is_listening = False


def _hear(event: str, arguments: Any) -> None:
  del arguments
  if _is_listening and event in _FORBIDDEN:
    _HEARD.append(event)


sys.addaudithook(_hear)  # Cannot be removed.


@contextlib.contextmanager
def _listening() -> Iterator[None]:
  global _is_listening
  _HEARD.clear()
  _is_listening = True
  try:
    yield
  finally:
    _is_listening = False


class Kind(NamedTuple):
  """A file, and a function whose result contains all of it as `repr`."""

  path: pathlib.Path
  read: Callable[[], Any]


@pytest.fixture(scope='module', name='kinds')
def _kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
  """Returns a file of each kind that this package writes and reads back."""
  folder = tmp_path_factory.mktemp('kinds')
  sweep = fake_sweep.build(folder / 'sweep', fake_sweep.experiment(seeds=[0]))
  [job] = [
      job
      for job in json.loads((sweep / scheduler.SWEEP).read_text())['jobs']
      if job['run'] == 'reward'
  ]
  run = sweep / job['folder']
  header = {'configuration': '0123456789ab', 'what': 'checkpoint'}
  state = {'weights': np.arange(20.0), 'done': 7, 'nothing': None,
           'names': ['a', 'b'], 'pair': (1, 2.5)}  # fmt: skip
  checkpoint = folder / storage.CHECKPOINT
  storage.write_archive(checkpoint, header, state)
  with suite.load(
      'collect_apples', 'standard', {'random': 0}, design=None
  ) as env:
    env.reset()
    world, world_header = env.save().to_bytes(), env.snapshot_header()
  snapshot, network = folder / 'world.snapshot', folder / 'net.npz'
  snapshot.write_bytes(world)
  network.write_bytes(network_files.load('demonstrator_v1').to_bytes())

  def load_snapshot() -> Any:
    loaded = snapshots.Snapshot.from_bytes(snapshot.read_bytes())
    return loaded.contents_for(world_header)

  def load_sweep() -> Any:
    loaded = studies.read_sweep(sweep)
    return loaded.experiment, [
        (run.name, run.planned, [*map(results.line, run.rows)], run.configs)
        for run in loaded.runs.values()
    ]  # fmt: skip

  def load_trace() -> Any:
    return studies.read_sweep(sweep).runs['reward'].traces

  return {
      'checkpoint': Kind(
          checkpoint, lambda: storage.read_archive(checkpoint, header)
      ),
      'snapshot': Kind(snapshot, load_snapshot),
      'network': Kind(network, lambda: network_files.load(network).digest()),
      'trace.bin': Kind(run / training.TRACE, load_trace),
      'config.json': Kind(run / storage.CONFIG, load_sweep),
  }


@pytest.mark.parametrize('name', _NAMES)
@examples.settings(12)
@hypothesis.given(data=st.data())
def test_a_damaged_file_is_refused_or_unchanged(
    kinds: dict[str, Kind], name: str, data: Any
):
  kind = kinds[name]
  whole = kind.path.read_bytes()
  others = [kinds[other].path.read_bytes() for other in _NAMES if other != name]
  expected = repr(kind.read())
  kind.path.write_bytes(data.draw(damage.damaged(whole, others)))
  refusal = ''
  try:
    with _listening():
      # White space in JSON may differ.
      assert repr(kind.read()) == expected
  except errors.RealabError as error:
    refusal = str(error)
  finally:
    kind.path.write_bytes(whole)
  assert len(refusal.splitlines()) <= 1
  assert len(refusal) < 2_000
  assert not _HEARD


def test_reading_a_pickle_is_heard():
  with _listening():
    pickle.loads(pickle.dumps(pathlib.PurePath('x')))
  assert 'pickle.find_class' in _HEARD

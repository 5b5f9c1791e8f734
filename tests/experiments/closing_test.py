"""Tests that environments and files are closed after a failure.

Environments are counted: those that were made, less those that were closed. A
batch and a fork hold one each.
"""

from collections.abc import Callable, Iterator
import errno
import functools
import io
import json
import pathlib
import shutil
import sys
import types
from typing import Any

from absl import flags
from absl.testing import flagsaver
import pytest

from realab_suite import _display
from realab_suite import suite
from realab_suite.audit import aiming
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_physics
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import placement
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import monitors
from realab_suite.experiments import curves
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import scripted
from realab_suite.experiments import storage
from realab_suite.experiments import training
from realab_suite.feedback import mechanisms
from realab_suite.launchers import explore
from tests.experiments import fake_learner
from tests.experiments import small

_TASK = ('unlock_door', 'near')
_DESIGN = 'instantaneous_reward'


class Failed(Exception):
  """An exception that a part of the program raises."""


class Stopped(BaseException):
  """An exception that, like ctrl-C, `except Exception` does not catch."""


class Environments:
  """The environments that are open."""

  def __init__(self) -> None:
    self.num_made = 0
    self.open: list[environment.Environment] = []


@pytest.fixture(name='made')
def _made(monkeypatch: pytest.MonkeyPatch) -> Environments:
  found = Environments()
  initialize = environment.Environment.__init__
  close = environment.Environment.close

  def counting_initialize(self: Any, *args: Any, **kwargs: Any) -> None:
    initialize(self, *args, **kwargs)
    found.num_made += 1
    found.open.append(self)

  def counting_close(self: Any) -> None:
    close(self)
    found.open = [one for one in found.open if one is not self]

  monkeypatch.setattr(environment.Environment, '__init__', counting_initialize)
  monkeypatch.setattr(environment.Environment, 'close', counting_close)
  return found


def _raise(kind: type[BaseException], after: int = 0) -> Callable[..., Any]:
  """Returns a function that raises when it has been called so many times."""
  calls = iter(range(10**9))

  def fail(*unused: Any, **unused_too: Any) -> None:
    if next(calls) >= after:
      raise kind

  return fail


# ---- Loading ----------------------------------------------------------------


def _load() -> environment.Environment:
  return suite.load(*_TASK, {'random': 0}, design=_DESIGN)


def _load_batch(**changes: Any) -> batch_environment.BatchEnvironment:
  kwargs = {'num_envs': 2, 'num_threads': 1, **changes}
  return suite.load_batch(*_TASK, {'random': 0}, design=_DESIGN, **kwargs)


@pytest.mark.parametrize(
    ('load', 'check', 'kind'),
    [
        (_load, 'check', Failed),
        (_load, 'check_start', Stopped),
        (_load_batch, 'check', Stopped),
    ],
)
def test_a_refused_world_is_closed(made, monkeypatch, kind, check, load):
  monkeypatch.setattr(placement, check, _raise(kind))
  with pytest.raises(kind):
    load()
  assert made.num_made == 1
  assert not made.open


@pytest.mark.parametrize(
    'changes', [{'num_envs': 0}, {'num_threads': -1}, {'sleep': 1}]
)
def test_a_refused_batch_is_closed(made, changes):
  with pytest.raises(ValueError, match='allowed are'):
    _load_batch(**changes)
  assert not made.open


@pytest.mark.parametrize(
    ('owner', 'name', 'kind'),
    [
        (batch_physics.BatchPhysics, '__init__', Failed),
        (mechanisms.FeedbackMechanism, 'initial_states', Stopped),
    ],
)
def test_a_batch_that_cannot_be_made_is_closed(
    made, monkeypatch, owner, name, kind
):
  monkeypatch.setattr(owner, name, _raise(kind))
  with pytest.raises(kind):
    _load_batch()
  assert made.num_made == 1
  assert not made.open


class _Sink(events.BatchEventSink):

  def step_ended(self, step: events.BatchStep) -> None:
    """Does nothing."""


@pytest.mark.parametrize(
    ('owner', 'name', 'kind', 'is_batch'),
    [
        (batch_physics.BatchPhysics, '__init__', Failed, False),
        (batch_environment.BatchEnvironment, 'add_sink', Stopped, True),
        (batch_environment.BatchEnvironment, 'restore', Failed, True),
    ],
)
def test_a_fork_that_fails_is_closed_and_the_original_is_not(
    made, monkeypatch, owner, name, kind, is_batch
):
  original = _load_batch() if is_batch else _load()
  original.reset()
  world = 1 if is_batch else None
  monkeypatch.setattr(owner, name, _raise(kind))
  with pytest.raises(kind):
    suite.fork(original, 3, world=world, sinks=[_Sink()])
  assert made.num_made == 2
  assert len(made.open) == 1
  monkeypatch.undo()
  original.close()


@pytest.mark.parametrize('num_envs', [0, 2.0])
def test_a_fork_that_is_refused_is_closed(made, num_envs):
  original = _load()
  original.reset()
  with pytest.raises(ValueError, match='num_envs'):
    suite.fork(original, num_envs)
  assert len(made.open) == 1
  original.close()
  assert not made.open


# ---- Jobs -------------------------------------------------------------------

_NUM_ENVS = 2
_SMALL = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'max_steps': 30,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': [
                'dof=planar',
                'action_set={name: dmlab_like, version: 1}',
            ],
        }
    },
    'baselines': ['random'],
    'seeds': [3],
    'training': {
        'num_envs': _NUM_ENVS,
        'steps': 20 * _NUM_ENVS,
        'checkpoint_every': 8 * _NUM_ENVS,
        'curve_every': 5 * _NUM_ENVS,
    },
    'evaluation': {'episodes': 2},
}


@functools.cache
def _job(run: str = 'reward', sleep: bool = False) -> jobs.Job:
  data = {**_SMALL, 'training': {**_SMALL['training'], 'sleep': sleep}}
  [job] = jobs.plan(experiment_specs.load(data), only=[run])
  return job


@pytest.fixture(autouse=True)
def _fake(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)


def _run(job: jobs.Job, output: pathlib.Path) -> None:
  training.run(job, output, training.Options(lambda line: None))


_BATCH = batch_environment.BatchEnvironment
_LEARNER = fake_learner.FakeLearner
# Functions that fail in training and evaluation, and after how many calls.
_PLACES: list[tuple[Any, str, int]] = [
    (training, 'make_learner', 0),
    (monitors.BatchMonitor, '__init__', 0),
    (_BATCH, 'add_sink', 0),
    (_BATCH, 'reset', 0),
    (_BATCH, 'reset', 1),
    (_BATCH, 'step', 9),
    (_BATCH, 'save', 0),
    (_LEARNER, 'state', 0),
    (_LEARNER, 'act', 0),
    (storage.JsonLines, '__init__', 1),
    (storage.RunFolder, 'finish', 0),
    (curves, 'point', 0),
]


def _fail_at(
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    after: int,
    kind: type[BaseException],
) -> None:
  """Makes a function fail when it has worked so many times."""
  works, fail = getattr(owner, name), _raise(kind, after)

  def failing(*args: Any, **kwargs: Any) -> Any:
    fail()
    return works(*args, **kwargs)

  monkeypatch.setattr(owner, name, failing)


@pytest.mark.parametrize(
    'place', _PLACES, ids=lambda place: f'{place[1]}-{place[2]}'
)
def test_a_job_that_fails_closes_its_worlds(made, tmp_path, monkeypatch, place):
  _fail_at(monkeypatch, *place, Failed)
  with pytest.raises(Failed):
    _run(_job(), tmp_path)
  assert made.num_made > 0
  assert not made.open


@pytest.mark.parametrize('after', [0, 2])
def test_a_job_whose_worlds_sleep_closes_them_in_every_segment(
    made, tmp_path, monkeypatch, after
):
  _fail_at(monkeypatch, monitors.BatchMonitor, '__init__', after, Stopped)
  with pytest.raises(Stopped):
    _run(_job(sleep=True), tmp_path)
  assert made.num_made == after + 1
  assert not made.open


@pytest.fixture(scope='module', name='stopped')
def _stopped(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
  """The output folder of a job that was stopped at its 13th step."""
  output = tmp_path_factory.mktemp('stopped')
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(training, 'make_learner', fake_learner.make)
    _fail_at(patch, _LEARNER, 'step', 12, Stopped)
    with pytest.raises(Stopped):
      _run(_job(), output)
  return output


@pytest.mark.parametrize(
    ('owner', 'name', 'kind'),
    [(_LEARNER, 'set_state', Failed), (_BATCH, 'restore', Stopped)],
)
def test_a_job_that_cannot_continue_closes_its_worlds(
    stopped, made, tmp_path, monkeypatch, owner, name, kind
):
  shutil.copytree(stopped, tmp_path, dirs_exist_ok=True)
  _fail_at(monkeypatch, owner, name, 0, kind)
  with pytest.raises(kind):
    _run(_job(), tmp_path)
  assert made.num_made == 1
  assert not made.open


def test_a_job_whose_lines_are_damaged_closes_its_worlds(
    stopped, made, tmp_path
):
  shutil.copytree(stopped, tmp_path, dirs_exist_ok=True)
  (tmp_path / _job().folder() / training.CURVE).write_bytes(b'')
  with pytest.raises(ValueError, match=r'curve\.jsonl: has 0 bytes'):
    _run(_job(), tmp_path)
  assert not made.open


@pytest.mark.parametrize(
    ('owner', 'name', 'after', 'kind'),
    [
        (_BATCH, 'step', 5, Failed),
        (_BATCH, 'add_sink', 0, Stopped),
        (storage, 'write_whole', 1, Failed),
    ],
)
def test_a_scripted_job_that_fails_closes_its_worlds(
    made, tmp_path, monkeypatch, owner, name, after, kind
):
  _fail_at(monkeypatch, owner, name, after, kind)
  with pytest.raises(kind):
    _run(_job('reward.random'), tmp_path)
  assert made.num_made == 1
  assert not made.open


# ---- Comparisons, windows and films -----------------------------------------


@pytest.mark.parametrize(
    ('owner', 'name', 'after', 'kind'),
    [(aiming, 'make_policy', 0, Failed), (evaluate, 'evaluate', 3, Stopped)],
)
def test_a_comparison_that_fails_closes_its_worlds(
    made, tmp_path, monkeypatch, owner, name, after, kind
):
  _fail_at(monkeypatch, owner, name, after, kind)
  with pytest.raises(kind):
    scripted.run(small.settings(tmp_path / 'new'), lambda line: None)
  assert made.num_made > 0
  assert not made.open


@pytest.fixture(name='window')
def _window(monkeypatch: pytest.MonkeyPatch) -> Iterator[types.SimpleNamespace]:
  """A viewer that opens no window."""
  viewer = types.SimpleNamespace(launch=lambda *unused, **unused_too: None)
  monkeypatch.setitem(sys.modules, 'dm_control.viewer', viewer)
  monkeypatch.setattr('dm_control.viewer', viewer, raising=False)
  monkeypatch.setattr(_display, 'has_display', lambda: True)
  with flagsaver.flagsaver():
    flags.FLAGS(['explore', '--policy=random', '--task=near'])
    yield viewer


def test_a_window_that_fails_closes_its_world(made, window):
  window.launch = _raise(Stopped)
  with pytest.raises(Stopped):
    explore.main(['explore'])
  assert made.num_made == 1
  assert not made.open


@pytest.mark.usefixtures('window')
def test_a_window_without_a_policy_closes_its_world(made, monkeypatch):
  monkeypatch.setattr(aiming, 'make_policy', _raise(Failed))
  with pytest.raises(Failed):
    explore.main(['explore'])
  assert made.num_made == 1
  assert not made.open


class _FakeFilm:
  """A file of imageio's that has no streams."""

  def __init__(self, path: pathlib.Path, kind: type[BaseException]) -> None:
    path.write_bytes(b'begun')
    self.is_open = True
    self.init_video_stream = _raise(kind)

  def close(self) -> None:
    self.is_open = False


@pytest.mark.parametrize(
    ('place', 'kind'),
    [('Camera', Failed), ('imopen', Stopped), ('init_video_stream', Stopped)],
)
def test_a_film_that_fails_leaves_no_file(tmp_path, monkeypatch, place, kind):
  videos = pytest.importorskip('realab_suite.reports.films')
  path = tmp_path / 'film.mp4'
  files = []

  def imopen(*unused: Any, **unused_too: Any) -> _FakeFilm:
    files.append(_FakeFilm(path, kind))
    return files[-1]

  monkeypatch.setattr(videos.engine, 'Camera', lambda *unused: None)
  monkeypatch.setattr(videos.imageio, 'imopen', imopen)
  if place == 'Camera':
    monkeypatch.setattr(videos.engine, 'Camera', _raise(kind))
  elif place == 'imopen':
    monkeypatch.setattr(videos.imageio, 'imopen', _raise(kind))
  env = _load()
  for _ in range(2):  # Nothing is in the way of another attempt.
    with pytest.raises(kind):
      with videos.film(env, path, 'title'):
        pass
  assert not any(file.is_open for file in files)
  assert not list(tmp_path.iterdir())
  env.close()


class _Unreadable(io.FileIO):
  """A file on a disk that is broken."""

  def read(self, *unused: Any) -> bytes:
    raise OSError(errno.EIO, 'Input/output error')


def test_lines_that_cannot_be_read_are_closed(tmp_path, monkeypatch):
  path = tmp_path / 'lines'
  path.write_text(json.dumps({'step': 1}) + '\n')
  opened = []

  def open_(name: Any, *unused: Any, **unused_too: Any) -> io.FileIO:
    opened.append(_Unreadable(name, 'a+'))
    return opened[-1]

  monkeypatch.setattr(storage, 'open', open_, raising=False)
  with pytest.raises(ValueError, match='lines: Input/output error'):
    storage.JsonLines(path, {'size': 4, 'sha256': ''})
  [file] = opened
  assert file.closed

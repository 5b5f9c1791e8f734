"""Tests that environments and files are closed after a failure.

Environments are counted: those that were made, less those that were closed. A
batch and a fork hold one each.
"""

from collections.abc import Callable
import functools
import pathlib
import shutil
from typing import Any

import pytest

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import placement
from realab_suite.evaluation import evaluate
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scripted
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import small

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
    [(_load, 'check_start', Stopped), (_load_batch, 'check', Failed)],
)
def test_a_refused_world_is_closed(made, monkeypatch, kind, check, load):
  monkeypatch.setattr(placement, check, _raise(kind))
  with pytest.raises(kind):
    load()
  assert made.num_made == 1
  assert not made.open


def test_a_batch_that_cannot_be_made_is_closed(made, monkeypatch):
  owner = batch_environment.BatchEnvironment
  monkeypatch.setattr(owner, '__init__', _raise(Failed))
  with pytest.raises(Failed):
    _load_batch()
  assert made.num_made == 1
  assert not made.open


class _Sink(events.BatchEventSink):

  def step_ended(self, step: events.BatchStep) -> None:
    """Does nothing."""


@pytest.mark.parametrize(
    ('owner', 'name', 'kind', 'is_batch'),
    [
        (batch_environment.BatchEnvironment, '__init__', Failed, False),
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


# ---- Jobs -------------------------------------------------------------------

_SMALL = {**small.EXPERIMENT, 'max_steps': 30}


@functools.cache
def _job(run: str = 'reward') -> jobs.Job:
  [job] = jobs.plan(experiment_specs.load(_SMALL), only=[run])
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
    (_BATCH, 'reset', 1),
    (_BATCH, 'step', 9),
    (_BATCH, 'save', 0),
    (storage.RunFolder, 'finish', 0),
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


def test_a_job_that_cannot_continue_closes_its_worlds(
    stopped, made, tmp_path, monkeypatch
):
  shutil.copytree(stopped, tmp_path, dirs_exist_ok=True)
  _fail_at(monkeypatch, _BATCH, 'restore', 0, Stopped)
  with pytest.raises(Stopped):
    _run(_job(), tmp_path)
  assert made.num_made == 1
  assert not made.open


def test_a_scripted_job_that_fails_closes_its_worlds(
    made, tmp_path, monkeypatch
):
  _fail_at(monkeypatch, _BATCH, 'step', 5, Failed)
  with pytest.raises(Failed):
    _run(_job('reward.random'), tmp_path)
  assert made.num_made == 1
  assert not made.open


# ---- Comparisons ------------------------------------------------------------


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

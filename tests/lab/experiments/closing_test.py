"""Tests that environments are closed after a failure.

Environments are counted: those that were made, less those that were closed. A
batch holds one.
"""

from typing import Any

import pytest

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import placement
from realab_suite.evaluation import evaluate
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import scripted
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from tests.lab.experiments import fake_learner
from tests.lab.experiments import small

_BATCH = batch_environment.BatchEnvironment


class Failed(Exception):
  """An exception that a part of the program raises."""


class Stopped(BaseException):
  """An exception that, like ctrl-C, `except Exception` does not catch."""


@pytest.fixture(name='made')
def _made(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
  """Returns a list with a value for each environment: `True` if it is open."""
  made: list[bool] = []
  initialize = environment.Environment.__init__
  close = environment.Environment.close
  numbers: dict[int, int] = {}

  def counting_initialize(self: Any, *args: Any, **kwargs: Any) -> None:
    initialize(self, *args, **kwargs)
    numbers[id(self)] = len(made)
    made.append(True)

  def counting_close(self: Any) -> None:
    close(self)
    made[numbers[id(self)]] = False

  monkeypatch.setattr(environment.Environment, '__init__', counting_initialize)
  monkeypatch.setattr(environment.Environment, 'close', counting_close)
  return made


def _fail_at(
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    after: int,
    kind: type[BaseException] = Failed,
) -> None:
  """Makes a function fail when it has worked so many times."""
  works, calls = getattr(owner, name), iter(range(10**9))

  def failing(*args: Any, **kwargs: Any) -> Any:
    if next(calls) >= after:
      raise kind
    return works(*args, **kwargs)

  monkeypatch.setattr(owner, name, failing)


# ---- Loading ----------------------------------------------------------------


def _load() -> environment.Environment:
  return suite.load('unlock_door', 'near', design='instantaneous_reward')


def _load_batch() -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'unlock_door', 'near', num_envs=2, design='instantaneous_reward'
  )


@pytest.mark.parametrize(
    ('load', 'owner', 'name', 'kind'),
    [
        (_load, placement.Placement, 'check', Stopped),
        (_load_batch, placement, 'check', Failed),
        (_load_batch, _BATCH, '__init__', Failed),
    ],
)
def test_a_world_that_cannot_be_loaded_is_closed(
    made, monkeypatch, load, owner, name, kind
):
  _fail_at(monkeypatch, owner, name, 0, kind)
  with pytest.raises(kind):
    load()
  assert made == [False]


# ---- Jobs -------------------------------------------------------------------

# Functions that fail in training and evaluation, and after how many calls.
_PLACES: list[tuple[Any, str, int]] = [
    (training, 'make_learner', 0),
    (_BATCH, 'step', 9),
    (storage, 'write_archive', 0),
    (storage, 'finish', 0),
]


@pytest.mark.parametrize('place', _PLACES, ids=lambda place: place[1])
def test_a_job_that_fails_closes_its_worlds(made, tmp_path, monkeypatch, place):
  monkeypatch.setattr(training, 'make_learner', fake_learner.make)
  experiment = experiment_specs.load({**small.EXPERIMENT, 'max_steps': 30})
  [job] = jobs.plan(experiment, only=['reward'])
  del made[:]
  _fail_at(monkeypatch, *place)
  with pytest.raises(Failed):
    training.run(job, tmp_path, training.Options(lambda line: None))
  assert made
  assert not any(made)


def test_a_comparison_that_fails_closes_its_worlds(made, tmp_path, monkeypatch):
  _fail_at(monkeypatch, evaluate, 'evaluate', 3, Stopped)
  with pytest.raises(Stopped):
    scripted.run(small.settings(tmp_path / 'new'), lambda line: None)
  assert made
  assert not any(made)

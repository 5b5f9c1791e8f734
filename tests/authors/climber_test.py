"""An odd learner keeps the contract, is trained and judged like the others."""

import copy
import functools
import importlib
import json
import pathlib
import sys
from typing import Any, Literal
from unittest import mock

import numpy as np
import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from realab_suite import testing
from realab_suite.evaluation import results
from realab_suite.lab import agents
from realab_suite.lab import testing as lab_testing
from realab_suite.lab.agents import defences
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training
from tests import registries
from tests.lab.experiments import small

_AUTHORS = 'tests.authors.climber'
_LEARNER = {'kind': 'climber', 'lures': 'reward', 'daring': 0.5}
_INDICES = ['action_set={name: dmlab_like, version: 1}']
_EXPERIMENT = {
    'schema': 1,
    'name': 'climbing',
    'task': 'unlock_door.near',
    'max_steps': 12,
    'runs': {
        'climber': {
            'design': 'instantaneous_reward',
            'overrides': [
                *_INDICES,
                'learner={kind: climber, lures: reward, daring: 0.5}',
            ],
        }
    },
    'baselines': ['random'],
    'seeds': [3],
    'calibration_seeds': [8],
    'training': {
        'num_envs': 4,
        'steps': 80,
        'checkpoint_every': 40,
        'curve_every': 40,
    },
    'evaluation': {'episodes': 3},
}


@pytest.fixture(scope='module', name='climber')
def fixture_climber() -> Any:
  """The module of the author, whose names other tests do not know."""
  with registries.preserved():
    yield importlib.import_module(_AUTHORS)
  del sys.modules[_AUTHORS]


def _check(make: Any) -> None:
  lab_testing.check_learner(make, overrides=_INDICES, num_steps=12)


def test_it_keeps_the_contract(climber: Any):
  del climber
  _check(functools.partial(agents.make, _LEARNER))


def test_it_is_trained_and_judged_by_the_register_that_it_names(
    climber: Any, tmp_path: pathlib.Path
):
  del climber
  [job] = jobs.plan(experiment_specs.load(_EXPERIMENT), only=['climber'])
  with small.quick_stakes():
    path = training.run(job, tmp_path, training.Options(lambda line: None))
  rows = list(results.read_rows(path / 'episodes.jsonl'))
  assert len(rows) == 3
  for row in rows:
    assert row.objective is not None
    observed = row.objective['return'].observed
    assert observed == pytest.approx(2 * row.observed_return)
  [*_, last] = (path / 'curve.jsonl').read_text().splitlines()
  assert json.loads(last)['learner']['num_steps'] == 80


def _told(
    climber: Any, folder: pathlib.Path, offset: int, monkeypatch: Any
) -> list[list[int]]:
  """Returns the numbers that a climber gets from where it is run."""
  told: list[list[int]] = []

  class Curious(climber.Climber):
    """Notes its seed and its keys."""

    def __init__(self, *arguments):
      told.append([arguments[-1]])
      super().__init__(*arguments)

    def _choose(self, observation, keys, greedy):
      told.extend([int(word) for word in key] for key in keys.values())
      return super()._choose(observation, keys, greedy)

  experiment = copy.deepcopy(_EXPERIMENT)
  experiment['evaluation'] |= {'seed_offset': offset}
  [job] = jobs.plan(experiment_specs.load(experiment), only=['climber'])
  with monkeypatch.context() as patch, small.quick_stakes():
    patch.setitem(agents.LEARNERS._entries, 'climber', Curious)
    path = training.run(job, folder, training.Options(lambda line: None))
  rows = results.read_rows(path / 'episodes.jsonl')
  assert {row.seed for row in rows} == {3 + offset}
  assert len(told) > 2 * 20 + 2 * 12  # It has acted in training and after it.
  return told


def test_a_learner_of_an_author_is_not_told_the_seeds_of_its_worlds(
    climber: Any, tmp_path: pathlib.Path, monkeypatch: Any
):
  told = _told(climber, tmp_path / 'one', 1_000_000, monkeypatch)
  assert told[0] != [3]
  # Nothing that it is told depends on the worlds of the evaluation.
  assert told == _told(climber, tmp_path / 'other', 77, monkeypatch)


class _Careless(defences.Defence):
  """A defence of an author, which changes nothing."""

  kind: Literal['careless'] = 'careless'

  def treat(self, batch, setting, state, key):
    raise NotImplementedError


@pytest.mark.parametrize(
    ('learner', 'is_of_package'),
    [
        ('learner.gamma=0.9', True),
        ('learner.defence={kind: cap, high: 9}', True),
        ('learner.defence={kind: careless}', False),
    ],
)
def test_learners_of_this_package_get_the_seed_of_their_job(
    climber: Any, learner: str, is_of_package: bool, monkeypatch: Any
):
  del climber
  defences.DEFENCES._entries['careless'] = _Careless
  run = {'design': 'instantaneous_reward', 'overrides': [learner]}
  experiment = experiment_specs.load(_EXPERIMENT | {'runs': {'own': run}})
  [job] = jobs.plan(experiment, only=['own'])
  make = mock.Mock()
  monkeypatch.setattr(agents, 'make', make)
  training.make_learner(job, mock.MagicMock())
  assert (make.call_args.kwargs['seed'] == 3) == is_of_package


def _breach(climber: Any, **members: Any) -> Any:
  """Returns a factory of climbers with other methods."""
  broken = type('Broken', (climber.Climber,), members)

  def make(*arguments: Any) -> Any:
    learner = agents.make(_LEARNER, *arguments)
    learner.__class__ = broken
    return learner

  return make


def _forgets(self: Any, state: Any) -> None:
  means = self.networks
  agents.Learner.set_state(self, state)
  self.networks = means


def _draws(self: Any, observation: Any, keys: Any, greedy: bool) -> Any:
  del keys, greedy
  num_envs = len(next(iter(observation.values())))
  return {'action': np.random.default_rng().integers(14, size=num_envs)}


def _learns_from_acting(
    self: Any, observation: Any, key: Any, greedy: bool = False
) -> Any:
  self._num_updates += 1
  return agents.Learner.act(self, observation, key, greedy)


def _changes_the_time_step(self: Any, time_step: Any) -> Any:
  for value in time_step.observation.values():
    value.flags.writeable = True
    value += 1
  return agents.Learner.step(self, time_step)


def _counts(self: Any, time_step: Any) -> Any:
  self.live = self.__dict__.setdefault('live', np.zeros(1))
  self.live += 1
  return agents.Learner.step(self, time_step)


def _shares(self: Any) -> Any:
  state = agents.Learner.state(self)
  return {**state, 'memory': {'live': self.live}}


def _accepts(self: Any, state: Any) -> None:
  agents.Learner.set_state(self, {**state, 'kind': 'climber'})


def _diverges(self: Any) -> Any:
  return {'best': np.nan}


_BREACHES: dict[str, tuple[dict[str, Any], str]] = {
    'forgets': ({'set_state': _forgets}, 'one with its state acts otherwise'),
    'draws from no seed': ({'_choose': _draws}, 'its twin acts otherwise'),
    'learns from acting': ({'act': _learns_from_acting}, 'changes the state'),
    'changes the time step': (
        {'step': _changes_the_time_step}, 'the time step was changed'
    ),
    'shares its arrays': (
        {'state': _shares, 'step': _counts}, 'later steps change it'
    ),
    'accepts any state': ({'set_state': _accepts}, 'is not refused'),
    'reports nan': ({'metrics': _diverges}, 'must be finite numbers'),
}  # fmt: skip


@pytest.mark.parametrize('breach', _BREACHES)
def test_a_breach_of_the_contract_is_named(climber: Any, breach: str):
  members, message = _BREACHES[breach]
  with pytest.raises(testing.ContractError, match=message):
    _check(_breach(climber, **members))

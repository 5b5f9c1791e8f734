"""An odd learner keeps the contract, is trained and judged like the others."""

import functools
import importlib
import json
import pathlib
import sys
from typing import Any

import numpy as np
import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from realab_suite import testing
from realab_suite.evaluation import results
from realab_suite.lab import agents
from realab_suite.lab import testing as lab_testing
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

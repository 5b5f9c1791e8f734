"""Definitions that a notebook or a reload runs again replace the old ones."""

import functools
import importlib
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.entities import appearance
from realab_suite.feedback import measurements
from realab_suite.feedback import objectives
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.tasks import registry as task_registry
from tests import registries

_TABLES = (
    measurements.MEASUREMENTS,
    objectives.DEFENCES,
    objectives.LEARNERS,
    objectives.OBJECTIVES,
    objectives.PAYMENTS,
    policies.POLICIES,
    policies.VALUE_FUNCTIONS,
    providers.PROVIDERS,
    register_kinds.REGISTER_KINDS,
)
# How to add an entry as `again`, and how to find it.
_REGISTRIES: dict[str, Any] = {
    names._what: (names.add, names.get) for names in _TABLES
} | {
    'task': (
        functools.partial(suite.register_task, 'again'),
        functools.partial(task_registry.find, 'again'),
    )
}
_CELL = """
import functools
class Mine:
  class Inner: pass
def made(): pass
def define():
  class Local: pass
  return Local
Local, nameless, partial = define(), lambda: None, functools.partial(made, 1)
"""
_MODULE = """
from typing import ClassVar, Literal
import numpy as np
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.tasks import collect_apples

@providers.PROVIDERS.add('again')
class Again(providers.Provider):
  kind: Literal['again']
  number: ClassVar = {number}

  def step(self, observation, readings, episode_start, key, state):
    return {{self.writes[0]: np.full(episode_start.shape, self.number)}}, state

@register_kinds.REGISTER_KINDS.add('again')
class Kind(registers.TwoBlockRegister):
  number = {number}

@suite.register_task('again', 'again')
class Task(collect_apples.CollectApples):
  number = {number}

  def __init__(self, **options):
    super().__init__('standard', **options)
"""
_DESIGN = {
    'schema': 1,
    'name': 'again',
    'registers': {
        'reward': {
            'kind': 'again',
            'role': 'feedback',
            'place': 'station_1',
            'range': [0, 12],
            'scale': 0.1,
        }
    },
    'providers': [{'kind': 'again', 'reads': [], 'writes': ['reward']}],
}


@pytest.fixture(autouse=True)
def _preserved() -> Any:
  with registries.preserved():
    yield


def _cell(module: str = '__main__') -> dict[str, Any]:
  """Runs the cell and returns its names."""
  names: dict[str, Any] = {'__name__': module}
  exec(_CELL, names)
  return names


@pytest.mark.parametrize('kind', ['Mine', 'made', 'partial'])
@pytest.mark.parametrize('what', _REGISTRIES)
def test_the_same_definition_replaces_and_another_is_refused(
    what: str, kind: str
):
  add, find = _REGISTRIES[what]
  first, second, other = _cell(), _cell(), _cell('elsewhere')
  add('again')(first[kind])
  add('again')(second[kind])
  assert find('again') is second[kind]
  inner = second['Mine'].Inner
  for entry in (other[kind], inner, second['Local'], second['nameless']):
    with pytest.raises(errors.SpecError, match=r'again.* registered already'):
      add('again')(entry)
    assert find('again') is second[kind]


@pytest.mark.parametrize('kind', ['Local', 'nameless'])
def test_what_functions_define_and_lambdas_are_not_replaced(kind: str):
  first = _cell()[kind]
  for _ in range(2):
    policies.POLICIES.add('again')(first)
  with pytest.raises(errors.SpecError, match='not inside a function'):
    policies.POLICIES.add('again')(_cell()[kind])


def test_sets_and_classes_of_objects_may_only_be_repeated():
  for _ in range(2):
    appearance.register('again', code=30, rgba=(0, 0, 0, 1))
    action_sets.register(action_sets.ActionSet('again', 1, (('no', {}),)))
  with pytest.raises(errors.SpecError, match='registered already'):
    action_sets.register(action_sets.ActionSet('again', 1, (('yes', {}),)))
  with pytest.raises(errors.SpecError, match='registered already'):
    appearance.register('again', code=30)


def test_a_reloaded_module_is_used_and_older_specs_keep_their_classes(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
):
  path = tmp_path / 'registered_again.py'
  monkeypatch.syspath_prepend(str(tmp_path))
  path.write_text(_MODULE.format(number=1.0))
  module = importlib.import_module('registered_again')
  old = specs.load(_DESIGN)
  assert worlds._task('again', 'again').number == 1.0
  path.write_text(_MODULE.format(number=11.25))
  importlib.reload(module)
  assert worlds._task('again', 'again').number == 11.25
  for design, number in ((old, 1.0), (specs.load(_DESIGN), 11.25)):
    env = suite.load('again', 'again', {'random': 0}, design=design)
    assert env.mechanism.registers['reward'].number == number
    assert env.task.number == 11.25
    env.reset()
    reading = env.step(np.zeros(env.action_spec().shape)).observation
    np.testing.assert_allclose(reading['registers/reward'], number, atol=0.01)
    env.close()

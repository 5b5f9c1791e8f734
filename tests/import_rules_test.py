"""This package follows the rules of `import_rules.py`, and each can fail."""

import pytest

from tests import import_rules

_PLANTED = 'realab_suite.entities.planted'


@pytest.fixture(scope='module', name='package')
def fixture_package():
  return import_rules.load_package()


def test_every_layer_that_exists_is_looked_at(package):
  names = {module.name for module in package}
  assert {'realab_suite', 'realab_suite.errors'} <= names
  assert {m.layer for m in package} >= {'entities', 'feedback', 'tasks'}


@pytest.mark.parametrize(
    'rule', import_rules.RULES, ids=lambda rule: rule.__name__
)
def test_our_code_keeps_the_rule(package, rule):
  complaints = list(rule(package))
  assert not complaints, '\n'.join(complaints)


def _complaints(rule, source, name=_PLANTED):
  return list(rule([import_rules.parse(source, name)]))


def _pairs(table):
  return [(key, value) for key, values in table.items() for value in values]


_FORBIDDEN = {
    'entities.planted': [
        'from realab_suite.feedback import specs',
        'import realab_suite.suite',
        'import realab_suite',
        'from realab_suite import engine as e',
        'from ..tasks import base',
        'from .. import tasks',
        'def f():\n  from realab_suite import tasks',
        "import importlib\nimportlib.import_module('realab_suite.tasks')",
    ],
    'config.planted': ['from realab_suite.entities import state'],
    'policies.planted': ['from realab_suite.feedback import specs'],
    'feedback.planted': ['from realab_suite import evaluation'],
    'tasks.planted': [
        'from realab_suite.feedback.providers import base',
        'from realab_suite import feedback',
        'from realab_suite.feedback import specs_extra',
        'from realab_suite.policies import random',
    ],
    'engine.planted': ['from realab_suite.evaluation import ledgers'],
    'evaluation.planted': ['from realab_suite import suite'],
    'agents.planted': [
        'from realab_suite.evaluation import ledgers',
        'from realab_suite.engine import environment',
        'from realab_suite.tasks import base',
        'from realab_suite.feedback import mechanisms',
        'from realab_suite import suite',
    ],
    'suite': ['from realab_suite import agents'],
    'worlds': ['from realab_suite.audit import audits'],
    'audit.planted': [
        'from realab_suite.agents import base',
        'from realab_suite.experiments import storage',
        'from realab_suite.reports import films',
    ],
    'interop.planted': ['from realab_suite.experiments import jobs'],
    'experiments.planted': ['from realab_suite.reports import plots'],
    'reports.planted': ['from realab_suite.launchers import program'],
    'datasets.planted': [
        'from realab_suite import agents',
        'from realab_suite.reports import plots',
    ],
    'errors': ['from realab_suite import entities'],
    'archive': ['from realab_suite.engine import snapshots'],
    'unheard_of': ['import numpy'],
}
_ALLOWED = {
    'entities.planted': [
        'from realab_suite import errors',
        'from realab_suite import __version__',
        'from realab_suite.entities import state',
        'from . import state',
        'import numpy as np',
    ],
    'tasks.planted': [
        'from realab_suite.feedback.specs import DesignSpec',
        'from realab_suite.policies import base',
    ],
    'engine.planted': ['from realab_suite import archive'],
    'suite': ['from realab_suite.evaluation import ledgers'],
    'audit.planted': ['from realab_suite import worlds'],
    'agents.planted': ['from realab_suite.config import registry'],
    'datasets.planted': ['from realab_suite.reports import replays'],
    'launchers.planted': ['from realab_suite.reports import page'],
    'experiments.planted': ['from realab_suite.interop.rpc import server'],
}


@pytest.mark.parametrize(('importer', 'statement'), _pairs(_FORBIDDEN))
def test_a_forbidden_import_is_found(importer, statement):
  name = f'realab_suite.{importer}'
  assert len(_complaints(import_rules.check_layers, statement, name)) == 1


@pytest.mark.parametrize(('importer', 'statement'), _pairs(_ALLOWED))
def test_an_allowed_import_is_not_found(importer, statement):
  name = f'realab_suite.{importer}'
  assert not _complaints(import_rules.check_layers, statement, name)


def test_relative_imports_of_a_package_start_at_the_package():
  module = import_rules.parse(
      'from .. import tasks',
      'realab_suite.entities',
      'realab_suite/entities/__init__.py',
  )
  assert len(list(import_rules.check_layers([module]))) == 1


_OFFENCES = {
    import_rules.check_pickle: [
        "import numpy as np\nnp.load('x', allow_pickle=True)",
    ],
    import_rules.check_getattr: [
        'class A:\n  def __getattr__(self, name): ...',
        'def __getattr__(name): ...',
    ],
    import_rules.check_classes: [
        'class A: ...',
        'class A:\n  class B: ...',
        'def f():\n  class A: ...',
    ],
}
_HARMLESS = {
    import_rules.check_pickle: [
        "import numpy as np\nnp.load('x', allow_pickle=False)"
    ],
    import_rules.check_getattr: ["getattr(1, 'real')"],
}


@pytest.mark.parametrize(('rule', 'source'), _pairs(_OFFENCES))
def test_a_planted_offence_is_found(rule, source):
  assert _complaints(rule, source)


@pytest.mark.parametrize(('rule', 'source'), _pairs(_HARMLESS))
def test_a_harmless_line_is_not_found(rule, source):
  assert not _complaints(rule, source)


_CLASS_IMPORTS = """
import abc
import dataclasses
import enum
from typing import NamedTuple, final
import pydantic
from dm_control import composer
"""
_ABSTRACT = (
    'class A(composer.Entity):\n  @abc.abstractmethod\n  def f(self): ...'
)


@pytest.mark.parametrize(
    'source',
    [
        '@final\nclass A: ...\n@final\nclass B(A): ...',
        '@final\nclass A(abc.ABC): ...',
        'class A(abc.ABC): ...\nclass B(A): ...',
        'class A(composer.Entity): ...',
        'class A(pydantic.BaseModel): ...',
        '@dataclasses.dataclass(frozen=True)\nclass A: ...',
        # B leaves nothing abstract, so it is concrete.
        f'{_ABSTRACT}\nclass B(A):\n  def f(self): ...\n',
        f'{_ABSTRACT}\nclass B(A):\n  f = 1\n',
    ],
)
def test_a_class_neither_abstract_nor_final_is_found(source):
  source = _CLASS_IMPORTS + source
  assert len(_complaints(import_rules.check_classes, source)) == 1


@pytest.mark.parametrize(
    'source',
    [
        '@final\nclass A: ...',
        '@final\n@dataclasses.dataclass(frozen=True)\nclass A: ...',
        'class A(abc.ABC): ...\n@final\nclass B(A): ...',
        'class A(metaclass=abc.ABCMeta): ...',
        'class A(ValueError): ...\nclass B(A): ...',
        'class A(enum.IntEnum): ...',
        'class A(NamedTuple): ...',
        'class A(composer.Observables): ...',
        'class A(pydantic.BaseModel): ...\n@final\nclass B(A): ...',
        # B is abstract because it leaves f open.
        f'{_ABSTRACT}\nclass B(A): ...\n',
    ],
)
def test_an_abstract_final_or_open_class_is_not_found(source):
  assert not _complaints(import_rules.check_classes, _CLASS_IMPORTS + source)


@pytest.mark.parametrize(
    'child',
    [
        'from realab_suite.entities import parent\nclass B(parent.A): ...',
        'from realab_suite.entities import A\nclass B(A): ...',
        'from realab_suite import entities as e\nclass B(e.A): ...',
        'import realab_suite.entities.parent\n'
        'class B(realab_suite.entities.parent.A): ...',
    ],
)
def test_a_final_class_is_followed_into_other_modules(child):
  modules = [
      ('from typing import final\n@final\nclass A: ...', 'entities.parent'),
      ('from realab_suite.entities.parent import A', 'entities'),
      (child, 'entities.child'),
  ]
  complaints = import_rules.check_classes(
      [
          import_rules.parse(source, f'realab_suite.{name}')
          for source, name in modules
      ]
  )
  assert any('A is final, but has subclasses' in c for c in complaints)

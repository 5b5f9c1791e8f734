"""The layers of `docs/architecture.md`, and rules that every module follows.

Files are parsed, so that nothing is imported to check what may be imported. A
rule returns its complaints about a module.
"""

import abc
import ast
from collections.abc import Iterator
import enum
import functools
import graphlib
import importlib
import inspect
import pathlib
import pkgutil
from typing import Any, is_typeddict

import pydantic
import pytest

import realab_suite

_ROOT = pathlib.Path(__file__).parents[1]
_PACKAGE = 'realab_suite'

# What each layer may import besides itself and `_FOUNDATION`. An entry that
# names a module admits that module alone.
_FOUNDATION = (
    'archive', 'errors', 'trees', 'sources', '_display', '_versions',
)  # fmt: skip
_BELOW_SUITE = (
    'config', 'configs', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    'evaluation',
)  # fmt: skip
_WITH_SUITE = (*_BELOW_SUITE, 'suite')
# The core imports no wing; `lab` imports the core; `reports` and `doors` import
# the lab as well, and not each other; `launchers` import everything.
_CORE = (*_WITH_SUITE, 'worlds', 'testing')
_MAY_IMPORT = {
    # Functions that are imported when they are asked for.
    '__init__': _WITH_SUITE,
    'archive': (),
    'errors': (),
    'trees': (),
    'sources': (),
    '_display': (),
    '_versions': (),
    'configs': (),
    'config': ('configs',),
    'entities': ('config',),
    'policies': ('config', 'configs', 'entities'),
    'feedback': ('config', 'configs', 'entities', 'policies'),
    # A task must not know the feedback function, so no providers.
    'tasks': (
        'config',
        'entities',
        'feedback.specs',
        'feedback.mechanisms',
        'policies.action_sets',
        'policies.base',
        'policies.errands',
        'policies.navigation',
    ),
    'engine': ('config', 'entities', 'policies', 'feedback', 'tasks'),
    'evaluation': (
        'config', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    ),
    'suite': _BELOW_SUITE,
    'worlds': _WITH_SUITE,
    'testing': (*_WITH_SUITE, 'worlds'),
    # Nothing here may reach the true reward.
    'lab.agents': (
        'config',
        'entities.appearance',
        'feedback.objectives',
        'feedback.specs',
        'policies',
    ),
    'lab': (),
    'lab.verdicts': _CORE,
    'lab.testing': _CORE,
    'lab.attribution': _CORE,
    'lab.audit': (*_CORE, 'lab.verdicts'),
    'lab.experiments': (*_CORE, 'lab'),
    'reports': (*_CORE, 'lab'),
    'doors': (*_CORE, 'lab'),
    'launchers': (*_CORE, 'lab', 'reports', 'doors'),
}  # fmt: skip

# The package imports its functions when they are asked for, and all worlds for
# lists of tasks; a binding looks up the arrays of MuJoCo by name, as that of
# dm_control does.
_ALLOWED_GETATTR = (
    _PACKAGE, f'{_PACKAGE}.suite', f'{_PACKAGE}.engine.single_physics',
)  # fmt: skip


@functools.cache
def _modules() -> list[tuple[str, ast.Module]]:
  """Returns the name and the tree of every module of the package."""
  found = []
  for path in sorted((_ROOT / _PACKAGE).rglob('*.py')):
    parts = path.relative_to(_ROOT).with_suffix('').parts
    name = '.'.join(part for part in parts if part != '__init__')
    found.append((name, ast.parse(path.read_text(encoding='utf-8'))))
  return found


def _layer(name: str) -> str:
  """Returns the room of a module; rooms of the lab have rows of their own."""
  _, *parts = [*name.split('.'), '__init__']
  return '.'.join(parts[:2]) if parts[0] == 'lab' and parts[2:] else parts[0]


def _layers(name: str, tree: ast.Module) -> list[str]:
  """A module imports only what its layer may, by its full name."""
  layer = _layer(name)
  if layer not in _MAY_IMPORT:
    return [f'{name}: no row in _MAY_IMPORT for {layer!r}']
  allowed = (*_FOUNDATION, layer, *_MAY_IMPORT[layer])
  complaints = []
  for node in ast.walk(tree):
    for target in _targets(node):
      inside = target.removeprefix(_PACKAGE).lstrip('.')
      if not target.startswith((_PACKAGE, '.')):
        continue
      if not any(f'{inside}.'.startswith(f'{one}.') for one in allowed):
        complaints.append(f'{name}:{node.lineno}: {layer} imports {target}')
  return complaints


def _targets(node: Any) -> list[str]:
  """Returns the full names that a statement, or `import_module`, imports."""
  if isinstance(node, ast.Import):
    return [alias.name for alias in node.names]
  if isinstance(node, ast.ImportFrom):
    # Names that begin with dots are complaints.
    source = '.' * node.level + (node.module or '')
    return [f'{source}.{alias.name}' for alias in node.names]
  function = node.func if isinstance(node, ast.Call) else None
  if isinstance(function, ast.Attribute) and function.attr == 'import_module':
    return [one.value for one in node.args[:1] if isinstance(one, ast.Constant)]
  return []


def _pickles(name: str, tree: ast.Module) -> list[str]:
  """Loading a pickle runs code; `ruff.toml` bans its modules."""
  return [
      f'{name}:{node.value.lineno}: {ast.unparse(node)}'
      for node in ast.walk(tree)
      if isinstance(node, ast.keyword)
      and ast.unparse(node).startswith('allow_pickle=')
      and ast.unparse(node.value) != 'False'
  ]


def _forwards(name: str, tree: ast.Module) -> list[str]:
  """Forwarding attributes punctures the boundary that hides the true reward."""
  return [
      f'{name}:{node.lineno}: {node.name} forwards attributes'
      for node in ast.walk(tree)
      if isinstance(node, ast.FunctionDef)
      and node.name in ('__getattr__', '__getattribute__')
      and name not in _ALLOWED_GETATTR
  ]


@pytest.mark.parametrize('rule', [_layers, _pickles, _forwards])
def test_our_code_keeps_the_rule(rule: Any):
  modules = _modules()
  assert {'realab_suite', 'realab_suite.errors'} <= {
      name for name, _ in modules
  }
  complaints = [c for module in modules for c in rule(*module)]
  assert not complaints, '\n'.join(complaints)


def _pairs(table: Any) -> list[Any]:
  return [(key, value) for key, values in table.items() for value in values]


_FORBIDDEN = {
    'entities.planted': [
        'from realab_suite.feedback import specs',
        'import realab_suite.suite',
        'import realab_suite',
        'from realab_suite import engine as e',
        'from ..tasks import base',
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
    'lab.agents.planted': [
        'from realab_suite.evaluation import ledgers',
        'from realab_suite.engine import environment',
        'from realab_suite.tasks import base',
        'from realab_suite.feedback import mechanisms',
        'from realab_suite import suite',
    ],
    'suite': ['from realab_suite.lab import agents'],
    'worlds': ['from realab_suite.lab.audit import audits'],
    'lab.audit.planted': [
        'from realab_suite.lab.agents import base',
        'from realab_suite.lab.experiments import storage',
        'from realab_suite.reports import films',
    ],
    'engine.also_planted': ['from realab_suite.lab.verdicts import stakes'],
    'lab.experiments.planted': [
        'from realab_suite.reports import plots',
        'from realab_suite.doors.served import server',
    ],
    'reports.planted': [
        'from realab_suite.launchers import program',
        'from realab_suite.doors.data import export',
    ],
    'doors.data.planted': ['from realab_suite.reports import plots'],
    'errors': ['from realab_suite import entities'],
    'archive': ['from realab_suite.engine import snapshots'],
    'unheard_of': ['import numpy'],
}
_ALLOWED = {
    'entities.planted': [
        'from realab_suite import errors',
        'from realab_suite import _versions',
        'from realab_suite.entities import state',
        'import numpy as np',
    ],
    'tasks.planted': [
        'from realab_suite.feedback.specs import DesignSpec',
        'from realab_suite.policies import base',
    ],
    'engine.planted': ['from realab_suite import archive'],
    'suite': ['from realab_suite.evaluation import ledgers'],
    'lab.audit.planted': ['from realab_suite import worlds'],
    'lab.agents.planted': ['from realab_suite.config import registry'],
    'doors.data.planted': ['from realab_suite.lab.experiments import replays'],
    'launchers.planted': ['from realab_suite.reports import page'],
    'doors.served.planted': ['from realab_suite.lab.audit import aiming'],
}


@pytest.mark.parametrize(('importer', 'statement'), _pairs(_FORBIDDEN))
def test_a_forbidden_import_is_found(importer: str, statement: str):
  assert len(_layers(f'realab_suite.{importer}', ast.parse(statement))) == 1


@pytest.mark.parametrize(('importer', 'statement'), _pairs(_ALLOWED))
def test_an_allowed_import_is_not_found(importer: str, statement: str):
  assert not _layers(f'realab_suite.{importer}', ast.parse(statement))


@pytest.mark.parametrize(
    ('rule', 'source', 'number'),
    [
        (_pickles, "np.load('x', allow_pickle=True)", 1),
        (_pickles, "np.load('x', allow_pickle=False)", 0),
        (_forwards, 'class A:\n  def __getattr__(self, name): ...', 1),
        (_forwards, 'def __getattr__(name): ...', 1),
        (_forwards, "getattr(1, 'real')", 0),
    ],
)
def test_planted_offences_are_found(rule: Any, source: str, number: int):
  assert len(rule('realab_suite.entities.planted', ast.parse(source))) == number


# Every class is abstract, final or open; mypy refuses subclasses of final ones.


def _is_decided(one: type) -> bool:
  """Returns True for a class that is abstract, final or open by its nature."""
  return bool(
      '__final__' in vars(one)
      or inspect.isabstract(one)
      or abc.ABC in one.__bases__
      or issubclass(one, BaseException | enum.Enum)
      or (issubclass(one, tuple) and hasattr(one, '_fields'))
      or getattr(one, '_is_protocol', False)
      or is_typeddict(one)
      or (issubclass(one, pydantic.BaseModel) and one.__subclasses__())
  )


def _classes(owner: Any, module: str) -> Iterator[type]:
  for one in list(vars(owner).values()):
    if isinstance(one, type) and one.__module__ == module and one is not owner:
      yield one
      if one.__qualname__.startswith(f'{getattr(owner, "__qualname__", "")}.'):
        yield from _classes(one, module)


def test_every_class_is_abstract_or_final():
  found = set()
  for info in pkgutil.walk_packages(realab_suite.__path__, f'{_PACKAGE}.'):
    try:
      module = importlib.import_module(info.name)
    except ModuleNotFoundError:  # It is in an extra.
      continue
    found |= set(_classes(module, info.name))
  assert len(found) > 200
  assert not [one for one in found if not _is_decided(one)]


def test_a_class_that_is_neither_is_found():
  class Plain:
    """Neither abstract nor final."""

  class Model(pydantic.BaseModel):
    """A model that is no base."""

  assert not _is_decided(Plain)
  assert not _is_decided(Model)


def test_no_files_import_each_other_in_a_circle():
  trees = dict(_modules())

  def imported(name):
    for node in ast.walk(trees[name]):
      for target in _targets(node):
        # The name of a module, or of something in it.
        module = target if target in trees else target.rpartition('.')[0]
        if module in trees and module not in (name, _PACKAGE):
          yield module

  graph = {name: set(imported(name)) for name in trees if name != _PACKAGE}
  assert graph[f'{_PACKAGE}.suite']
  graphlib.TopologicalSorter(graph).prepare()  # Raises CycleError.

"""Enforces the layers of `docs/architecture.md`, and what no module may do.

Nothing is imported: every file under realab_suite/ is parsed. Each rule is a
function from parsed modules to complaints, so that it can be shown to fail on a
planted module as well as to pass on ours.
"""

import ast
import builtins
from collections.abc import Iterator
import dataclasses
import functools
import pathlib
import re

import pytest

_ROOT = pathlib.Path(__file__).parents[1]
_PACKAGE = 'realab_suite'

# What each layer may import besides itself and `_FOUNDATION`. An entry that
# names a module admits that module alone.
_FOUNDATION = ('archive', 'errors', '_display', '_versions')
_BELOW_SUITE = (
    'config', 'configs', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    'evaluation',
)  # fmt: skip
_MAY_IMPORT = {
    '__init__': (),
    'archive': (),
    'errors': (),
    '_display': (),
    '_versions': (),
    'configs': (),
    'config': ('configs',),
    'entities': (),
    'policies': ('config', 'configs', 'entities'),
    'feedback': ('config', 'configs', 'entities', 'policies'),
    # A task must not know the feedback function, so no providers.
    'tasks': (
        'config',
        'entities',
        'feedback.specs',
        'feedback.mechanisms',
        'policies.base',
    ),
    'engine': ('config', 'entities', 'policies', 'feedback', 'tasks'),
    'evaluation': (
        'config', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    ),
    # Nothing here may reach the true reward.
    'agents': ('config', 'feedback.specs', 'policies.action_sets'),
    'suite': _BELOW_SUITE,
    'interop': (*_BELOW_SUITE, 'suite'),
    'experiments': (*_BELOW_SUITE, 'suite', 'agents', 'interop'),
    'reports': (*_BELOW_SUITE, 'suite', 'agents', 'interop', 'experiments'),
    'launchers': (
        *_BELOW_SUITE, 'suite', 'agents', 'interop', 'experiments', 'reports',
    ),
    # The old name of a command, which imports nothing.
    'explore': (),
}  # fmt: skip

_PICKLES = ('pickle', 'cloudpickle', 'dill', 'shelve', 'marshal')
_UNSAFE_YAML = re.compile(r'yaml\.(load|(full|unsafe)_load)(_all)?')
_LOCAL_GENERATORS = (
    'BitGenerator',
    'Generator',
    'MT19937',
    'PCG64',
    'PCG64DXSM',
    'Philox',
    'RandomState',
    'SeedSequence',
    'default_rng',
)
# Bases whose children are neither abstract nor final, each by its own nature.
_OPEN_BASES = re.compile(
    r'enum\.\w*(Enum|Flag)|typing\.(NamedTuple|Protocol|TypedDict)'
    r'|dm_control\.(\w+\.)*\w*Observables'
)
_PYDANTIC_BASES = re.compile(r'pydantic\.(BaseModel|RootModel)')
_FINAL = ('typing.final', 'typing_extensions.final')


@dataclasses.dataclass(frozen=True)
class Module:
  """One parsed file."""

  name: str
  path: str
  tree: ast.Module

  @property
  def layer(self) -> str:
    """First part of the name inside the package; `__init__` for its root."""
    return [*self.name.split('.'), '__init__'][1]

  @functools.cached_property
  def imports(self) -> list[tuple[ast.stmt, str, str]]:
    """Statement, full dotted target and local name of everything imported."""
    found = []
    for node in ast.walk(self.tree):
      if isinstance(node, ast.Import):
        for alias in node.names:
          local = alias.asname or alias.name.split('.')[0]
          found.append((node, alias.name, local))
      elif isinstance(node, ast.ImportFrom):
        source = self._source(node)
        for alias in node.names:
          found.append(
              (node, f'{source}.{alias.name}', alias.asname or alias.name)
          )
    return found

  def _source(self, node: ast.ImportFrom) -> str:
    if not node.level:
      return node.module
    package = self.name.split('.')
    if not self.path.endswith('__init__.py'):
      package = package[:-1]
    package = package[: len(package) - node.level + 1]
    return '.'.join(package + ([node.module] if node.module else []))

  def dotted(self, node: ast.expr) -> str:
    """Full dotted name of a name or attribute, through the imports."""
    if isinstance(node, ast.Subscript):  # Base[T]
      return self.dotted(node.value)
    if isinstance(node, ast.Call):  # @decorator(...)
      return self.dotted(node.func)
    if isinstance(node, ast.Attribute):
      return f'{self.dotted(node.value)}.{node.attr}'
    if isinstance(node, ast.Name):
      return self.local_names.get(node.id, node.id)
    return '?'

  @functools.cached_property
  def local_names(self) -> dict[str, str]:
    """Full dotted name of each name that an import binds."""
    names = {}
    for node, target, local in self.imports:
      # `import a.b` binds `a`, unlike `import a.b as c`.
      plain = isinstance(node, ast.Import) and '.' not in local
      whole = plain and target.split('.')[0] == local
      names[local] = local if whole else target
    return names

  def complaint(self, node: ast.AST, text: str) -> str:
    return f'{self.path}:{node.lineno}: {text}'


def _parse(source: str, name: str, path: str | None = None) -> Module:
  path = path or name.replace('.', '/') + '.py'
  return Module(name=name, path=path, tree=ast.parse(source))


def _load_package() -> list[Module]:
  modules = []
  for file in sorted((_ROOT / _PACKAGE).rglob('*.py')):
    path = file.relative_to(_ROOT)
    parts = path.with_suffix('').parts
    name = '.'.join(p for p in parts if p != '__init__')
    modules.append(_parse(file.read_text(encoding='utf-8'), name, str(path)))
  return modules


@pytest.fixture(scope='module', name='package')
def fixture_package():
  return _load_package()


# ---- Rules: from modules to complaints --------------------------------------


def check_layers(modules: list[Module]) -> Iterator[str]:
  """A module imports only what its layer may."""
  for module in modules:
    if module.layer not in _MAY_IMPORT:
      yield f'{module.path}:1: no row in _MAY_IMPORT for {module.layer!r}'
      continue
    allowed = (*_FOUNDATION, module.layer, *_MAY_IMPORT[module.layer])
    for node, target in _targets(module):
      inside = target.removeprefix(_PACKAGE).lstrip('.')
      if not target.startswith(_PACKAGE) or inside == '__version__':
        continue
      if not any(f'{inside}.'.startswith(f'{a}.') for a in allowed):
        yield module.complaint(node, f'{module.layer} may not import {target}')


def _targets(module: Module) -> Iterator[tuple[ast.AST, str]]:
  """Import statements, and imports by `importlib.import_module('...')`."""
  for node, target, _ in module.imports:
    yield node, target
  for node in ast.walk(module.tree):
    if (
        isinstance(node, ast.Call)
        and module.dotted(node.func) == 'importlib.import_module'
        and isinstance(node.args[0], ast.Constant)
    ):
      yield node, node.args[0].value


def check_assert(modules: list[Module]) -> Iterator[str]:
  """`python -O` removes asserts, and they do not say what to do."""
  for module, node in _walk(modules):
    if isinstance(node, ast.Assert):
      yield module.complaint(
          node, 'assert; raise an error that says what to do'
      )


def check_print(modules: list[Module]) -> Iterator[str]:
  """What a library prints ends up in other people's output."""
  for module, node in _walk(modules):
    if isinstance(node, ast.Call) and module.dotted(node.func) == 'print':
      yield module.complaint(node, 'print; use absl.logging')


def check_pickle(modules: list[Module]) -> Iterator[str]:
  """Loading a pickle runs code."""
  for module in modules:
    for node, target, _ in module.imports:
      if target.split('.')[0] in _PICKLES:
        yield module.complaint(node, f'import of {target}')
  for module, node in _walk(modules):
    if isinstance(node, ast.keyword) and node.arg == 'allow_pickle':
      if not (
          isinstance(node.value, ast.Constant) and node.value.value is False
      ):
        yield module.complaint(node.value, 'allow_pickle')


def check_yaml(modules: list[Module]) -> Iterator[str]:
  """YAML comes from strangers: `feedback.loading` is the one safe door."""
  for module, node, name in _uses_of_imports(modules):
    if _UNSAFE_YAML.fullmatch(name):
      yield module.complaint(node, f'{name}; use feedback.loading')


def check_global_random(modules: list[Module]) -> Iterator[str]:
  """Every stream is derived from a seed; global generators have none."""
  for module, node, name in _uses_of_imports(modules):
    drawn = re.fullmatch(r'(?:numpy\.random|random)\.(\w+)', name)
    if drawn and drawn[1] not in (*_LOCAL_GENERATORS, 'Random'):
      yield module.complaint(node, f'{name} draws from a global generator')


def check_getattr(modules: list[Module]) -> Iterator[str]:
  """Forwarding attributes punctures the boundary that hides the true reward."""
  for module, node in _walk(modules):
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
      if node.name in ('__getattr__', '__getattribute__'):
        yield module.complaint(node, f'{node.name} forwards attributes')


def _walk(modules: list[Module]) -> Iterator[tuple[Module, ast.AST]]:
  for module in modules:
    for node in ast.walk(module.tree):
      yield module, node


def _uses_of_imports(
    modules: list[Module],
) -> Iterator[tuple[Module, ast.expr, str]]:
  """Names and attributes with their full dotted names; no local variables."""
  for module, node in _walk(modules):
    root = node
    while isinstance(root, ast.Attribute):
      root = root.value
    if isinstance(root, ast.Name) and root.id in module.local_names:
      yield module, node, module.dotted(node)


def check_classes(modules: list[Module]) -> Iterator[str]:
  """Every class is abstract or final, except those that `_open` names."""
  hierarchy = _Hierarchy(modules)
  for name, (module, node) in hierarchy.classes.items():
    final = any(module.dotted(d) in _FINAL for d in node.decorator_list)
    if final and name in hierarchy.parents:
      yield module.complaint(node, f'{node.name} is final, but has subclasses')
    elif final and hierarchy.is_abstract(name):
      yield module.complaint(node, f'{node.name} is final, but abstract')
    elif not (final or hierarchy.is_abstract(name) or hierarchy.is_open(name)):
      yield module.complaint(node, f'{node.name} is neither abstract nor final')


class _Hierarchy:
  """The classes of some modules and their bases, by full dotted name."""

  def __init__(self, modules: list[Module]):
    self._modules = {module.name: module for module in modules}
    self.classes = {}
    for module in modules:
      self._collect(module, module.tree, module.name)
    self.parents = {b for name in self.classes for b in self._bases(name)}

  def _collect(self, module: Module, node: ast.AST, prefix: str) -> None:
    for child in ast.iter_child_nodes(node):
      if isinstance(child, ast.ClassDef):
        name = f'{prefix}.{child.name}'
        self.classes[name] = (module, child)
        self._collect(module, child, name)
      else:
        self._collect(module, child, prefix)

  def _resolve(self, module: Module, name: str) -> str:
    """Follows a name to its class, also through a package's re-exports."""
    if f'{module.name}.{name}' in self.classes:
      return f'{module.name}.{name}'
    owner, _, attribute = name.rpartition('.')
    if name not in self.classes and owner in self._modules:
      for _, target, local in self._modules[owner].imports:
        if local == attribute and target != name:
          return self._resolve(self._modules[owner], target)
    return name

  def _bases(self, name: str) -> list[str]:
    module, node = self.classes[name]
    return [self._resolve(module, module.dotted(base)) for base in node.bases]

  def is_abstract(self, name: str) -> bool:
    module, node = self.classes[name]
    metaclasses = [
        module.dotted(k.value) for k in node.keywords if k.arg == 'metaclass'
    ]
    return (
        'abc.ABC' in self._bases(name)
        or 'abc.ABCMeta' in metaclasses
        or bool(self._abstract_methods(name))
    )

  def _abstract_methods(self, name: str) -> set[str]:
    """Names that still have no body, own and inherited."""
    if name not in self.classes:
      return set()
    module, node = self.classes[name]
    own = {
        method.name: any(
            module.dotted(d).startswith('abc.abstract')
            for d in method.decorator_list
        )
        for method in node.body
        if isinstance(method, ast.FunctionDef)
    }
    inherited = {
        m for b in self._bases(name) for m in self._abstract_methods(b)
    }
    # A class attribute gives an abstract property its value, too.
    given = {
        getattr(target, 'id', None)
        for statement in node.body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        for target in getattr(statement, 'targets', None) or [statement.target]
    }
    return {m for m, abstract in own.items() if abstract} | (
        inherited - own.keys() - given
    )

  def is_open(self, name: str) -> bool:
    """Exceptions, enums and the like; pydantic models that are bases."""
    ancestors = self._ancestors(name)
    if any(_PYDANTIC_BASES.fullmatch(a) for a in ancestors):
      return name in self.parents
    return any(_OPEN_BASES.fullmatch(a) or _is_exception(a) for a in ancestors)

  def _ancestors(self, name: str) -> set[str]:
    if name not in self.classes:
      return {name}
    return {a for base in self._bases(name) for a in self._ancestors(base)}


def _is_exception(name: str) -> bool:
  builtin = getattr(builtins, name, None)
  return isinstance(builtin, type) and issubclass(builtin, BaseException)


_RULES = [
    check_layers,
    check_assert,
    check_print,
    check_pickle,
    check_yaml,
    check_global_random,
    check_getattr,
    check_classes,
]


# ---- Our own code -----------------------------------------------------------


def test_every_layer_that_exists_is_looked_at(package):
  names = {module.name for module in package}
  assert {'realab_suite', 'realab_suite.errors'} <= names
  assert {m.layer for m in package} >= {'entities', 'feedback', 'tasks'}


@pytest.mark.parametrize('rule', _RULES, ids=lambda rule: rule.__name__)
def test_our_code_keeps_the_rule(package, rule):
  complaints = list(rule(package))
  assert not complaints, '\n'.join(complaints)


# ---- Each rule can fail -----------------------------------------------------


def _complaints(rule, source, name='realab_suite.entities.planted'):
  return list(rule([_parse(source, name)]))


@pytest.mark.parametrize(
    ('importer', 'statement'),
    [
        ('entities.planted', 'from realab_suite.feedback import specs'),
        ('entities.planted', 'import realab_suite.suite'),
        ('entities.planted', 'import realab_suite'),
        ('entities.planted', 'from realab_suite import engine as e'),
        ('entities.planted', 'from ..tasks import base'),
        ('entities.planted', 'from .. import tasks'),
        ('entities.planted', 'def f():\n  from realab_suite import tasks'),
        (
            'entities.planted',
            "import importlib\nimportlib.import_module('realab_suite.tasks')",
        ),
        ('config.planted', 'from realab_suite.entities import state'),
        ('config.planted', 'from realab_suite.feedback import specs'),
        ('policies.planted', 'from realab_suite.feedback import specs'),
        ('policies.planted', 'from realab_suite.engine import physics'),
        ('feedback.planted', 'from realab_suite import evaluation'),
        ('feedback.planted', 'from realab_suite.tasks import base'),
        ('tasks.planted', 'from realab_suite.feedback import providers'),
        ('tasks.planted', 'from realab_suite.feedback.providers import base'),
        ('tasks.planted', 'from realab_suite import feedback'),
        ('tasks.planted', 'from realab_suite.feedback import specs_extra'),
        ('tasks.planted', 'from realab_suite.policies import random'),
        ('engine.planted', 'from realab_suite import experiments'),
        ('engine.planted', 'from realab_suite.evaluation import ledger'),
        ('evaluation.planted', 'from realab_suite import agents'),
        ('evaluation.planted', 'from realab_suite import suite'),
        ('agents.planted', 'from realab_suite.evaluation import ledger'),
        ('agents.planted', 'from realab_suite.engine import environment'),
        ('agents.planted', 'from realab_suite.tasks import base'),
        ('agents.planted', 'from realab_suite.feedback import mechanism'),
        ('agents.planted', 'from realab_suite import suite'),
        ('suite', 'from realab_suite import agents'),
        ('suite', 'from realab_suite.experiments import jobs'),
        ('explore', 'from realab_suite import agents'),
        ('interop.planted', 'from realab_suite import agents'),
        ('interop.planted', 'from realab_suite.experiments import jobs'),
        ('experiments.planted', 'from realab_suite.reports import plots'),
        ('experiments.planted', 'from realab_suite import launchers'),
        ('reports.planted', 'from realab_suite.launchers import program'),
        ('suite', 'from realab_suite.interop.rpc import server'),
        ('evaluation.planted', 'from realab_suite import interop'),
        ('errors', 'from realab_suite import entities'),
        ('archive', 'from realab_suite import entities'),
        ('archive', 'from realab_suite.engine import snapshot'),
        ('unheard_of', 'import numpy'),
    ],
)
def test_a_forbidden_import_is_found(importer, statement):
  name = f'realab_suite.{importer}'
  assert len(_complaints(check_layers, statement, name)) == 1


@pytest.mark.parametrize(
    ('importer', 'statement'),
    [
        ('entities.planted', 'from realab_suite import errors'),
        ('archive', 'from realab_suite import errors'),
        ('engine.planted', 'from realab_suite import archive'),
        ('entities.planted', 'from realab_suite import __version__'),
        ('entities.planted', 'from realab_suite.entities import state'),
        ('entities.planted', 'from . import state'),
        ('entities.planted', 'import numpy as np'),
        ('tasks.planted', 'from realab_suite.feedback import specs'),
        ('tasks.planted', 'from realab_suite.feedback.specs import DesignSpec'),
        ('tasks.planted', 'from realab_suite.policies import base'),
        ('evaluation.planted', 'from realab_suite.engine import events'),
        ('suite', 'from realab_suite.evaluation import ledger'),
        ('agents.planted', 'from realab_suite.config import registry'),
        ('reports.planted', 'from realab_suite.experiments import jobs'),
        ('launchers.planted', 'from realab_suite.reports import page'),
        ('experiments.planted', 'from realab_suite import agents'),
        ('experiments.planted', 'from realab_suite import suite'),
        ('experiments.planted', 'from realab_suite.interop.rpc import server'),
        ('interop.planted', 'from realab_suite.engine import agent_view'),
    ],
)
def test_an_allowed_import_is_not_found(importer, statement):
  assert not _complaints(check_layers, statement, f'realab_suite.{importer}')


def test_relative_imports_of_a_package_start_at_the_package():
  module = _parse(
      'from .. import tasks',
      'realab_suite.entities',
      'realab_suite/entities/__init__.py',
  )
  assert len(list(check_layers([module]))) == 1


@pytest.mark.parametrize(
    ('rule', 'source'),
    [
        (check_assert, 'assert True'),
        (check_print, 'print(1)'),
        (check_pickle, 'import pickle'),
        (check_pickle, 'from cloudpickle import dumps'),
        (check_pickle, "import numpy as np\nnp.load('x', allow_pickle=True)"),
        (check_yaml, "import yaml\nyaml.load('x')"),
        (check_yaml, "import yaml as y\ny.full_load('x')"),
        (check_yaml, "from yaml import unsafe_load_all\nunsafe_load_all('x')"),
        (check_global_random, 'import numpy as np\nnp.random.uniform()'),
        (check_global_random, 'import numpy\nnumpy.random.seed(0)'),
        (check_global_random, 'from numpy import random\nrandom.normal()'),
        (check_global_random, 'import numpy.random as r\nr.shuffle([])'),
        (check_global_random, 'import random\nrandom.random()'),
        (check_global_random, 'from random import choice\nchoice([1])'),
        (check_getattr, 'class A:\n  def __getattr__(self, name): ...'),
        (check_getattr, 'def __getattr__(name): ...'),
        (check_classes, 'class A: ...'),
        (check_classes, 'class A:\n  class B: ...'),
        (check_classes, 'def f():\n  class A: ...'),
    ],
)
def test_a_planted_offence_is_found(rule, source):
  assert _complaints(rule, source)


@pytest.mark.parametrize(
    ('rule', 'source'),
    [
        (check_print, 'sprint(1)'),
        (check_pickle, "import numpy as np\nnp.load('x', allow_pickle=False)"),
        (check_yaml, "import yaml\nyaml.compose('x')"),
        (check_global_random, 'import numpy as np\nnp.random.default_rng(1)'),
        (check_global_random, 'def f(random: np.random.RandomState): ...'),
        (check_global_random, 'import random\nrandom.Random(1)'),
        (check_global_random, 'def f(random): return random.uniform()'),
        (check_global_random, 'def f(state): return state.random.uniform()'),
        (check_getattr, "getattr(1, 'real')"),
    ],
)
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
        'class A(composer.Entity):\n'
        '  @abc.abstractmethod\n'
        '  def f(self): ...\n'
        'class B(A):\n'
        '  def f(self): ...\n',
        'class A(composer.Entity):\n'
        '  @property\n'
        '  @abc.abstractmethod\n'
        '  def f(self): ...\n'
        'class B(A):\n'
        '  f = 1\n',
    ],
)
def test_a_class_neither_abstract_nor_final_is_found(source):
  assert len(_complaints(check_classes, _CLASS_IMPORTS + source)) == 1


@pytest.mark.parametrize(
    'source',
    [
        '@final\nclass A: ...',
        '@final\n@dataclasses.dataclass(frozen=True)\nclass A: ...',
        'class A(abc.ABC): ...',
        'class A(metaclass=abc.ABCMeta): ...',
        'class A(abc.ABC): ...\n@final\nclass B(A): ...',
        'class A(ValueError): ...\nclass B(A): ...',
        'class A(enum.IntEnum): ...',
        'class A(NamedTuple): ...',
        'class A(composer.Observables): ...',
        'class A(pydantic.BaseModel): ...\n@final\nclass B(A): ...',
        # B is abstract because it leaves f open.
        'class A(composer.Entity):\n'
        '  @abc.abstractmethod\n'
        '  def f(self): ...\n'
        'class B(A): ...\n',
    ],
)
def test_an_abstract_final_or_open_class_is_not_found(source):
  assert not _complaints(check_classes, _CLASS_IMPORTS + source)


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
  parent = 'from typing import final\n@final\nclass A: ...'
  complaints = check_classes(
      [
          _parse(parent, 'realab_suite.entities.parent'),
          _parse(
              'from realab_suite.entities.parent import A',
              'realab_suite.entities',
              'realab_suite/entities/__init__.py',
          ),
          _parse(child, 'realab_suite.entities.child'),
      ]
  )
  assert any('A is final, but has subclasses' in c for c in complaints)

"""The layers of `docs/architecture.md`, and rules that every module follows.

Nothing is imported: every file under realab_suite/ is parsed. Each rule is a
function from parsed modules to complaints, so that `import_rules_test.py` can
show that it passes on this package and fails on a planted module.
"""

import ast
import builtins
from collections.abc import Iterator
import dataclasses
import functools
import pathlib
import re

_ROOT = pathlib.Path(__file__).parents[1]
_PACKAGE = 'realab_suite'

# What each layer may import besides itself and `_FOUNDATION`. An entry that
# names a module admits that module alone.
_FOUNDATION = ('archive', 'errors', 'trees', '_display', '_versions')
_BELOW_SUITE = (
    'config', 'configs', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    'evaluation',
)  # fmt: skip
_WITH_SUITE = (*_BELOW_SUITE, 'suite')
_MAY_IMPORT = {
    # Functions that are imported when they are asked for.
    '__init__': _WITH_SUITE,
    'archive': (),
    'errors': (),
    'trees': (),
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
    ),
    'engine': ('config', 'entities', 'policies', 'feedback', 'tasks'),
    'evaluation': (
        'config', 'entities', 'policies', 'feedback', 'tasks', 'engine',
    ),
    # Nothing here may reach the true reward.
    'agents': (
        'config',
        'entities.appearance',
        'feedback.objectives',
        'feedback.specs',
        'policies.action_sets',
    ),
    'suite': _BELOW_SUITE,
    'worlds': _WITH_SUITE,
    'testing': _WITH_SUITE,
    'audit': (*_WITH_SUITE, 'worlds'),
    'interop': _WITH_SUITE,
    'experiments': (*_WITH_SUITE, 'worlds', 'audit', 'agents', 'interop'),
    'reports': (
        *_WITH_SUITE, 'worlds', 'audit', 'agents', 'interop', 'experiments',
    ),
    # Runs and replays, and nothing that draws.
    'datasets': (
        *_WITH_SUITE,
        'worlds',
        'audit',
        'experiments',
        'reports.replays',
        'reports.sweep_results',
    ),
    'launchers': (
        *_WITH_SUITE, 'worlds', 'audit', 'agents', 'interop', 'experiments',
        'reports', 'datasets',
    ),
    # Finds out which of them work.
    'doctor': ('experiments', 'launchers'),
}  # fmt: skip

# The package imports its functions when they are asked for, and a binding looks
# up the arrays of MuJoCo by name, as that of dm_control does.
_ALLOWED_GETATTR = (_PACKAGE, f'{_PACKAGE}.engine.single_physics')
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


def parse(source: str, name: str, path: str | None = None) -> Module:
  path = path or name.replace('.', '/') + '.py'
  return Module(name=name, path=path, tree=ast.parse(source))


def load_package() -> list[Module]:
  modules = []
  for file in sorted((_ROOT / _PACKAGE).rglob('*.py')):
    path = file.relative_to(_ROOT)
    parts = path.with_suffix('').parts
    name = '.'.join(p for p in parts if p != '__init__')
    modules.append(parse(file.read_text(encoding='utf-8'), name, str(path)))
  return modules


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


def check_pickle(modules: list[Module]) -> Iterator[str]:
  """Loading a pickle runs code; `ruff.toml` bans its modules."""
  for module, node in _walk(modules):
    if isinstance(node, ast.keyword) and node.arg == 'allow_pickle':
      if not (
          isinstance(node.value, ast.Constant) and node.value.value is False
      ):
        yield module.complaint(node.value, 'allow_pickle')


def check_getattr(modules: list[Module]) -> Iterator[str]:
  """Forwarding attributes punctures the boundary that hides the true reward."""
  for module, node in _walk(modules):
    if module.name in _ALLOWED_GETATTR:
      continue
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
      if node.name in ('__getattr__', '__getattribute__'):
        yield module.complaint(node, f'{node.name} forwards attributes')


def _walk(modules: list[Module]) -> Iterator[tuple[Module, ast.AST]]:
  for module in modules:
    for node in ast.walk(module.tree):
      yield module, node


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


RULES = [
    check_layers,
    check_pickle,
    check_getattr,
    check_classes,
]

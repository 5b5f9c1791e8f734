"""A digest of the sources that results depend on.

These are the core and the lab, and the modules that the user imports, with what
they import in turn from outside of installed packages. Files are known by their
names in the package and modules by their names, so the digest depends neither
on the machine nor on folders. Designs and versions of other packages are
recorded beside it.
"""

import ast
from collections.abc import Iterable, Iterator
import contextlib
import functools
import hashlib
from importlib import machinery
from importlib import util
import pathlib
import sys
import sysconfig
from typing import Final

FOLDER: Final = pathlib.Path(__file__).parent
"""Folder of the package."""

# No job runs them, unless a module of the user imports them. In a wheel,
# `configs` is a folder of the package, and beside it elsewhere.
_UNUSED = (
    'configs/',
    'doors/',
    'launchers/',
    'reports/',
    'testing/',
    'lab/testing/',
)
_NUM_DIGITS = 12
_INSTALLED = frozenset({'site-packages', 'dist-packages'})
_STANDARD = pathlib.Path(sysconfig.get_path('stdlib'))
_Specs = dict[str, machinery.ModuleSpec | None]
# Modules that the user names, and those that were loaded with them.
_named: set[str] = set()
_loaded: set[str] = set()


def use(named: Iterable[str], loaded: Iterable[str]) -> None:
  """Says which modules of the user are sources of this process.

  Args:
    named: Names of modules of the user, which may be installed.
    loaded: Names of the modules that were loaded with them.
  """
  for modules, names in ((_named, named), (_loaded, loaded)):
    modules.clear()
    modules.update(names)
  digest.cache_clear()
  digest()


@functools.cache
def digest() -> str:
  """Returns the digest of the sources when this process began to use them."""
  return current_digest()


def current_digest() -> str:
  """Returns the digest of the sources as they are now."""
  files = {
      path.relative_to(FOLDER).as_posix(): path
      for path in FOLDER.rglob('*.py')
      if _is_used(path)
  }
  specs: _Specs = {}
  for name in sorted(_named | _loaded):
    _add(name, specs)
  files |= {
      name: pathlib.Path(spec.origin)
      for name, spec in specs.items()
      if spec is not None and spec.has_location and spec.origin
  }
  whole = hashlib.sha256()
  for name, path in sorted(files.items()):
    data = _read(path)
    whole.update(f'{name} {len(data)}\n'.encode() + data)
  return whole.hexdigest()[:_NUM_DIGITS]


def _is_used(path: pathlib.Path) -> bool:
  """Returns True for a file of the package that jobs run."""
  inside = f'{path.relative_to(FOLDER).parent.as_posix()}/'
  return not inside.startswith(_UNUSED)


def _add(name: str, specs: _Specs) -> None:
  """Adds a module, its packages and what it imports to the sources.

  Nothing is imported, so that what a module imports later has no effect yet.

  Args:
    name: Full name of the module, or of something in it.
    specs: Specs of modules by name; `None` for those that are no sources.
  """
  if name in specs:
    return
  specs[name] = None
  parent, _, _ = name.rpartition('.')
  if parent:
    _add(parent, specs)
  spec = _find(name, specs.get(parent))
  if spec is None or _is_known(name, spec):
    return
  specs[name] = spec
  package = parent if spec.submodule_search_locations is None else name
  if spec.origin and spec.origin.endswith('.py'):
    for imported in _imports(_read(pathlib.Path(spec.origin)), package):
      _add(imported, specs)


def _find(
    name: str, parent: machinery.ModuleSpec | None
) -> machinery.ModuleSpec | None:
  """Returns the spec of a module, or `None` if there is none."""
  if name in sys.modules:
    return getattr(sys.modules[name], '__spec__', None)
  if '.' not in name:
    return util.find_spec(name) if name else None
  if parent is None or parent.submodule_search_locations is None:
    return None
  return machinery.PathFinder.find_spec(name, parent.submodule_search_locations)


def _is_known(name: str, spec: machinery.ModuleSpec) -> bool:
  """Returns True for modules that the digest or a version covers already."""
  top = name.partition('.')[0]
  places = [spec.origin, *(spec.submodule_search_locations or ())]
  paths = [pathlib.Path(place) for place in places if place]
  if top == FOLDER.name:
    return any(p.is_relative_to(FOLDER) and _is_used(p) for p in paths[:1])
  if top in {one.partition('.')[0] for one in _named}:
    return False
  return not paths or any(
      _INSTALLED.intersection(path.parts)
      or path.is_relative_to(_STANDARD)
      or not path.is_absolute()  # Built in, or frozen.
      for path in paths
  )


def _imports(data: bytes, package: str) -> Iterator[str]:
  """Yields the full names that a source imports, at any depth.

  Args:
    data: The source.
    package: Package that its relative imports begin at.
  """
  try:
    tree = ast.parse(data)
  except (SyntaxError, ValueError):  # Not imported yet.
    return
  for node in ast.walk(tree):
    if isinstance(node, ast.Import):
      yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
      base = node.module or ''
      if node.level:
        with contextlib.suppress(ImportError):
          base = util.resolve_name('.' * node.level + base, package)
      yield from (f'{base}.{alias.name}' for alias in node.names)


def _read(path: pathlib.Path) -> bytes:
  """Returns the contents of a file, with the line endings of Unix."""
  try:
    return path.read_bytes().replace(b'\r\n', b'\n')
  except OSError:  # Removed since it was imported.
    return b''

"""Rules of code that the contracts of imports in `setup.cfg` cannot express.

Files are parsed, so that nothing is imported to check what it may do. A rule
returns its complaints about a module.
"""

import abc
import ast
from collections.abc import Iterator
import enum
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
# The package imports its functions when they are asked for, and all worlds for
# lists of tasks; a binding looks up the arrays of MuJoCo by name, as that of
# dm_control does.
_ALLOWED_GETATTR = ('__init__', 'suite', 'engine/single_physics')


def _pickles(node: ast.AST) -> bool:
  """Loading a pickle runs code; `ruff.toml` bans its modules."""
  return (
      isinstance(node, ast.keyword)
      and node.arg == 'allow_pickle'
      and ast.unparse(node.value) != 'False'
  )


def _forwards(node: ast.AST) -> bool:
  """Forwarding attributes punctures the boundary that hides the true reward."""
  return isinstance(node, ast.FunctionDef) and node.name in (
      '__getattr__', '__getattribute__',
  )  # fmt: skip


def _imports_by_name(node: ast.AST) -> bool:
  """The contracts see statements only."""
  return (
      isinstance(node, ast.Call)
      and ast.unparse(node.func).endswith('import_module')
      and _PACKAGE in ast.unparse(node.args[0])
  )


@pytest.mark.parametrize(
    ('rule', 'allowed', 'planted'),
    [
        (_pickles, (), "np.load('x', allow_pickle=True)"),
        (_forwards, _ALLOWED_GETATTR, 'def __getattr__(name): ...'),
        (_imports_by_name, (), "i.import_module('realab_suite.tasks')"),
    ],
)
def test_our_code_keeps_the_rule(rule: Any, allowed: Any, planted: str):
  assert any(map(rule, ast.walk(ast.parse(planted))))
  folder = _ROOT / _PACKAGE
  names = {
      path.relative_to(folder).with_suffix('').as_posix(): path
      for path in folder.rglob('*.py')
  }
  assert {'errors', *allowed} <= names.keys()
  assert not [
      f'{name}:{getattr(node, "lineno", "?")}: {rule.__doc__}'
      for name, path in names.items()
      for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
      if rule(node) and name not in allowed
  ]


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

"""Registry of classes and functions by the names that designs use.

The entries are registered elsewhere, beside their definitions. A registry of
this package lists the modules of its own entries, which are imported when they
are asked for, so that a program imports only what its designs name.
"""

from collections.abc import Callable, Iterator, Mapping
import functools
import importlib
import types
from typing import Any, Generic, TypeVar, final

from realab_suite import errors
from realab_suite.config import messages

HOW_TO_REPLACE = (
    'choose another name; a notebook or a reloaded module may define it again,'
    ' with the same name and not inside a function'
)
"""Advice on a name that is taken, for messages."""

T = TypeVar('T')


@final
class Registry(Generic[T]):
  """Mapping from the names that designs use to classes or functions."""

  def __init__(
      self, what: str, modules: Mapping[str, str] | None = None
  ) -> None:
    """Makes a registry.

    Args:
      what: Kind of the entries, for messages: 'provider kind'.
      modules: Modules of the package that register entries, by their names.
    """
    self._what = what
    self._modules = dict(modules or {})
    self._entries: dict[str, T] = {}

  def add(self, name: str) -> Callable[[T], T]:
    """Returns a decorator that registers a class or function as `name`.

    Raises:
      SpecError: If the name is taken, and not by an earlier definition of the
        same; see `is_same`.
    """

    def decorate(entry: T) -> T:
      self._import(name)
      if name in self._entries and not is_same(self._entries[name], entry):
        raise errors.SpecError(
            f'{self._what} {name!r} is registered already, as'
            f' {messages.quote(self._entries[name])}; {HOW_TO_REPLACE}'
        )
      self._entries[name] = entry
      return entry

    return decorate

  def get(self, name: str) -> T:
    """Returns the class or function registered as `name`.

    Raises:
      UnknownNameError: If nothing is registered as `name`.
    """
    if name not in self._entries:
      self._import(name)
    if name not in self._entries:
      hint = messages.did_you_mean(name, [*self])
      raise errors.UnknownNameError(
          f'{self._what} {messages.quote(name)} is unknown{hint}; known are'
          f' {sorted(self)}, and others once their module is imported, as by'
          ' --import'
      )
    return self._entries[name]

  def __iter__(self) -> Iterator[str]:
    return iter(self._modules | self._entries)

  def __len__(self) -> int:
    return len(self._modules | self._entries)

  def __contains__(self, name: object) -> bool:
    return name in self._modules or name in self._entries

  def _import(self, name: str) -> None:
    """Imports the module that registers an entry of the package, if any."""
    if name in self._modules:
      importlib.import_module(self._modules[name])


def is_same(old: Any, new: Any) -> bool:
  """Returns True if an entry is another one, defined again.

  So a cell of a notebook may run twice, and a module may be reloaded: what is
  made from now on is of the new class. Classes and functions are the same if
  their modules and qualified names are. What a function defines, and lambdas,
  may be different things of one name, and are not.
  """
  if isinstance(old, functools.partial) and isinstance(new, functools.partial):
    return is_same(old.func, new.func)
  kinds = type | types.FunctionType
  if old is new or not (isinstance(old, kinds) and isinstance(new, kinds)):
    return old is new
  name = new.__qualname__
  return '<' not in name and (old.__module__, old.__qualname__) == (
      new.__module__,
      name,
  )

"""Registry of classes and functions by the names that designs use.

The entries are registered elsewhere, beside their definitions. A registry of
this package lists the modules of its own entries, which are imported when they
are asked for, so that a program imports only what its designs name.
"""

from collections.abc import Callable, Iterator, Mapping
import importlib
from typing import Generic, TypeVar, final

from realab_suite import errors
from realab_suite.config import messages

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
      SpecError: If the name is taken.
    """

    def decorate(entry: T) -> T:
      self._import(name)
      if name in self._entries:
        raise errors.SpecError(
            f'{self._what} {name!r} is registered already, as'
            f' {messages.quote(self._entries[name])}; choose another name;'
            ' in a notebook, run the cell that registers it once'
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

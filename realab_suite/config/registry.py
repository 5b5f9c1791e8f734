"""Registry of classes and functions by the names that designs use.

The entries are registered elsewhere, beside their definitions.
"""

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar, final

from realab_suite import errors
from realab_suite.config import messages

T = TypeVar('T')


@final
class Registry(Generic[T]):
  """Mapping from the names that designs use to classes or functions."""

  def __init__(self, what: str) -> None:
    """Makes an empty registry.

    Args:
      what: Kind of the entries, for messages: 'provider kind'.
    """
    self._what = what
    self._entries: dict[str, T] = {}

  def add(self, name: str) -> Callable[[T], T]:
    """Returns a decorator that registers a class or function as `name`.

    Raises:
      SpecError: If the name is taken.
    """

    def decorate(entry: T) -> T:
      if name in self._entries:
        raise errors.SpecError(
            f'{self._what} {name!r} is registered already, as'
            f' {messages.quote(self._entries[name])}; allowed is another name;'
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
      hint = messages.did_you_mean(name, self._entries)
      raise errors.UnknownNameError(
          f'{self._what} {messages.quote(name)} is unknown{hint}; known are'
          f' {sorted(self)}'
      )
    return self._entries[name]

  def __iter__(self) -> Iterator[str]:
    return iter(self._entries)

  def __len__(self) -> int:
    return len(self._entries)

  def __contains__(self, name: object) -> bool:
    return name in self._entries

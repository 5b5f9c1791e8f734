"""Finds the objects that public names of others lead to."""

from collections.abc import Iterator
import traceback
import types
from typing import Any, NamedTuple

import numpy as np

# By what names wrappers may lead to what they wrap, besides those of `dir`.
_PROBED = 'env', 'environment', 'mechanism', 'physics', 'task', 'unwrapped'
_LEAVES = (str, bytes, int, float, complex, type(None), type, types.ModuleType)


class Found(NamedTuple):
  """An object, and the way to it."""

  path: str
  value: Any


def reach(roots: dict[str, Any], depth: int = 8) -> Iterator[Found]:
  """Yields the objects that can be reached, nearest first.

  Ways are public names, elements of containers, what methods are bound to,
  closures, and what exceptions hold on to; never modules and classes. The walk
  begins at `roots`, objects by name, and takes `depth` steps.
  """
  todo = [Found(name, value) for name, value in roots.items()]
  seen: dict[int, Any] = {}  # What has been seen has to stay alive.
  for _ in range(depth + 1):
    further = []
    for path, value in todo:
      if id(value) not in seen and not isinstance(value, _LEAVES):
        seen[id(value)] = value
        yield Found(path, value)
        further += [Found(path + step, part) for step, part in _steps(value)]
    todo = further


def _steps(value: Any) -> Iterator[tuple[str, Any]]:
  if isinstance(value, np.ndarray):
    yield '.base', value.base
    return
  if isinstance(value, dict):
    for key, part in value.items():
      yield f'[{key!r:.40}]', part
  elif isinstance(value, list | tuple | set | frozenset):
    for i, part in enumerate(value):
      yield f'[{i}]', part
  if isinstance(value, BaseException):
    for frame, _ in traceback.walk_tb(value.__traceback__):
      for name, part in frame.f_locals.items():
        yield f'.{frame.f_code.co_name}():{name}', part
  for name in ('__self__', '__wrapped__', '__cause__', '__context__'):
    yield f'.{name}', _get(value, name)
  if isinstance(closure := _get(value, '__closure__'), tuple):
    for i, cell in enumerate(closure):
      yield f'.__closure__[{i}]', _get(cell, 'cell_contents')
  for name in (*dir(value), *_PROBED):
    if not name.startswith('_'):
      yield f'.{name}', _get(value, name)


def _get(value: Any, name: str) -> Any:
  try:
    return getattr(value, name)
  except Exception:  # A property may raise what it likes.
    return None

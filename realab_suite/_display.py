"""Postpones the choice of a renderer until the first frame is drawn.

Importing dm_control chooses a renderer and starts EGL. With software rendering,
EGL loads Mesa's LLVM and makes its symbols visible to all libraries that are
loaded later. A library with another LLVM, such as torch's triton, then ends the
process with a segmentation fault.
"""

from collections.abc import Iterator
import contextlib
import ctypes
import functools
import importlib
from importlib import util
import os
import pathlib
import sys
import threading
from typing import Any

_VARIABLE = 'MUJOCO_GL'
# Renderers that start a driver when dm_control imports them; glfw does not.
_STARTED_BY_IMPORT = ('egl', 'osmesa')
# Packages, with their libraries, that look up symbols of their own LLVM
# globally.
_WITH_LLVM = (('triton', '_C/libtriton*.so'),)

_lock = threading.Lock()


def has_display() -> bool:
  """Returns True if the environment variables say that there is a display."""
  if sys.platform != 'linux':
    return True
  return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def postpone_choice() -> None:
  """Makes dm_control choose a renderer when the first frame is drawn.

  dm_control then loads the renderer in `MUJOCO_GL`, or EGL if the variable is
  not set and there is no display. This function has no effect if dm_control has
  chosen a renderer already, or would choose one that starts no driver.
  """
  default = None if has_display() else 'egl'
  if (os.environ.get(_VARIABLE) or default) not in _STARTED_BY_IMPORT:
    return
  if 'dm_control._render' in sys.modules:
    return
  with _set_variable('disable'):
    _import_choice().Renderer = _make_renderer


@functools.cache
def load_llvm() -> None:
  """Loads libraries with their own LLVM before GL loads another LLVM.

  The library that is loaded first keeps its own symbols. Loading such a library
  after Mesa's LLVM fails.
  """
  maps = pathlib.Path('/proc/self/maps')
  if not maps.exists() or 'libLLVM' in maps.read_text(encoding='utf-8'):
    return
  for package, library in _WITH_LLVM:
    for folder in _folders(package):
      for path in pathlib.Path(folder).glob(library):
        with contextlib.suppress(OSError):
          ctypes.CDLL(os.fspath(path))


def _make_renderer(*args: Any, **kwargs: Any) -> Any:
  """Chooses a renderer and makes one.

  Reloads dm_control's choice, which replaces this function by the class of the
  chosen renderer.
  """
  choice = _import_choice()
  with _lock:
    if choice.Renderer is _make_renderer:
      load_llvm()
      with _set_variable(os.environ.get(_VARIABLE) or 'egl'):
        importlib.reload(choice)
  return choice.Renderer(*args, **kwargs)


def _import_choice() -> Any:
  return importlib.import_module('dm_control._render')


@contextlib.contextmanager
def _set_variable(renderer: str) -> Iterator[None]:
  """Sets `MUJOCO_GL` and restores it at the end of the context."""
  before = os.environ.get(_VARIABLE)
  os.environ[_VARIABLE] = renderer
  try:
    yield
  finally:
    if before is None:
      del os.environ[_VARIABLE]
    else:
      os.environ[_VARIABLE] = before


def _folders(package: str) -> list[str]:
  """Returns the folders of a package without importing the package."""
  try:
    spec = util.find_spec(package)
  except ValueError:  # A module without a spec replaces the package.
    return []
  return [] if spec is None else list(spec.submodule_search_locations or ())

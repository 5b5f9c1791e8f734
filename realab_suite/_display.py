"""Postpones the choice of a renderer until the first frame is drawn.

dm_control chooses a renderer when it is imported, and starts EGL with it. Where
EGL renders in software, that loads Mesa's LLVM and makes its symbols visible to
every library that is loaded later. A library with another LLVM, such as torch's
triton, then ends the process with a segmentation fault.
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
# These start a driver when dm_control imports them; glfw does so later.
_STARTED_BY_IMPORT = ('egl', 'osmesa')
# Package and library of what looks up the symbols of its own LLVM globally.
_WITH_LLVM = (('triton', '_C/libtriton*.so'),)

_lock = threading.Lock()


def has_display() -> bool:
  """Returns whether windows can be opened, as far as the environment says."""
  if sys.platform != 'linux':
    return True
  return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def postpone_choice() -> None:
  """Imports dm_control's choice of a renderer without making it.

  The renderer that `MUJOCO_GL` names is loaded when it is first used, and EGL
  where it names none and there is no display. Where dm_control has chosen
  already, or would choose a renderer that starts no driver, nothing changes.
  """
  default = None if has_display() else 'egl'
  if (os.environ.get(_VARIABLE) or default) not in _STARTED_BY_IMPORT:
    return
  if 'dm_control._render' in sys.modules:
    return
  with _named('disable'):
    _import_choice().Renderer = _make_renderer


@functools.cache
def load_llvm() -> None:
  """Loads libraries with an LLVM of their own, before GL brings another.

  What is loaded first keeps its own symbols. After Mesa it would be too late:
  to load such a library then is what fails.
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
  """Chooses a renderer and makes one; dm_control's own takes its place."""
  choice = _import_choice()
  with _lock:
    if choice.Renderer is _make_renderer:
      load_llvm()
      with _named(os.environ.get(_VARIABLE) or 'egl'):
        importlib.reload(choice)
  return choice.Renderer(*args, **kwargs)


def _import_choice() -> Any:
  return importlib.import_module('dm_control._render')


@contextlib.contextmanager
def _named(renderer: str) -> Iterator[None]:
  """Sets `MUJOCO_GL` for a while."""
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
  """Returns the folders of a package, which is not imported."""
  try:
    spec = util.find_spec(package)
  except ValueError:  # Something stands in for the package.
    return []
  return [] if spec is None else list(spec.submodule_search_locations or ())

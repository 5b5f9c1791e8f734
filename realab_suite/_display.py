"""Preparations for rendering, before dm_control is imported.

Importing dm_control chooses a renderer: that of `MUJOCO_GL`, or else GLFW, but
GLFW needs a display. `engine/gl_contexts.py` makes the contexts of worlds.

That import starts EGL if it is named. With software rendering, EGL loads Mesa's
LLVM and makes its symbols visible to all libraries that are loaded later. A
library with another LLVM, such as torch's triton, then ends the process with a
segmentation fault.
"""

import contextlib
import ctypes
import functools
from importlib import util
import os
import pathlib
import sys
import warnings

_VARIABLE = 'MUJOCO_GL'
_RENDERERS = {
    'egl': 'egl (headless)',
    'glfw': 'glfw (with a display)',
    'osmesa': 'osmesa (if it is installed)',
}
# Renderers that dm_control starts when it is imported.
_STARTED_BY_IMPORT = ('egl', 'osmesa')
# GLFW's warning that there is no display.
_NO_DISPLAY = r'\(65550\) .*DISPLAY'
# Packages, with their libraries, that look up symbols of their own LLVM
# globally.
_WITH_LLVM = (('triton', '_C/libtriton*.so'),)


def has_display() -> bool:
  """Returns True if the environment variables say that there is a display."""
  if sys.platform != 'linux':
    return True
  return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def is_named() -> bool:
  """Returns True if the user, or a launcher, has named a renderer."""
  return bool(os.environ.get(_VARIABLE))


def prepare() -> None:
  """Prepares the import of dm_control, without choosing a renderer for it.

  If `MUJOCO_GL` names a renderer that dm_control starts when it is imported,
  libraries with an LLVM of their own are loaded first. If none is named and
  there is no display, a warning of GLFW is suppressed, because worlds are then
  drawn with EGL. This function has no effect if dm_control has chosen a
  renderer already.
  """
  if 'dm_control._render' in sys.modules:
    return
  if os.environ.get(_VARIABLE) in _STARTED_BY_IMPORT:
    load_llvm()
  elif not (is_named() or has_display()):
    warnings.filterwarnings('ignore', _NO_DISPLAY, UserWarning)


def what_to_set(renderer: str | None, error: Exception | str) -> str:
  """Returns advice on an error: the renderer, the cause and alternatives."""
  lines = str(error).strip().splitlines()
  texts = [text for name, text in _RENDERERS.items() if name != renderer]
  named = os.environ.get(_VARIABLE)
  # That of dm_control may have been chosen without the variable.
  setting = f'{_VARIABLE}={named}' if named else f'the renderer {renderer}'
  return (
      f'{setting} ({lines[0] if lines else type(error).__name__}); set'
      f' {_VARIABLE} to {", ".join(texts[:-1])} or {texts[-1]} before Python'
      ' starts'
  )


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


def _folders(package: str) -> list[str]:
  """Returns the folders of a package without importing the package."""
  try:
    spec = util.find_spec(package)
  except ValueError:  # A module without a spec replaces the package.
    return []
  return [] if spec is None else list(spec.submodule_search_locations or ())

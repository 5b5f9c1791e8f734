"""Sees to it that frames can be drawn where there is no display.

dm_control looks at `MUJOCO_GL` once, when it is imported. Left alone, it takes
a renderer that needs a display, even where there is none.
"""

import ctypes
import os
import sys

CHOSEN_BY_USER = bool(os.environ.get('MUJOCO_GL'))
"""Whether `MUJOCO_GL` was set when this package was imported."""


def has_display() -> bool:
  """Returns whether windows can be opened, as far as the environment says."""
  if sys.platform != 'linux':
    return True
  return bool(os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'))


def prefer_egl() -> None:
  """Sets `MUJOCO_GL` to `egl` if nothing else is set and nothing else works."""
  if not CHOSEN_BY_USER and not has_display() and _num_egl_devices():
    os.environ['MUJOCO_GL'] = 'egl'


def _num_egl_devices() -> int:
  """Returns how many devices EGL knows; none of them is started."""
  number = ctypes.c_int(0)
  try:
    egl = ctypes.CDLL('libEGL.so.1')
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b'eglQueryDevicesEXT')
  except (OSError, AttributeError):
    return 0
  if not address:
    return 0
  query = ctypes.CFUNCTYPE(
      ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int)
  )(address)
  query(0, None, ctypes.byref(number))
  return number.value

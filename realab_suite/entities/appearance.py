"""Appearance of geoms: colours for cameras, class codes for the ray sense."""

from typing import Any

import numpy as np

# The index of a name is the code that the ray sense reports. Append new classes
# at the end, because the codes are part of the observation.
CLASSES = (
    'nothing',
    'other',
    'wall',
    'barrier',
    'door',
    'pad',
    'pressed_pad',
    'apple',
    'large_apple',
    'base_block',
    'offset_block',
)

COLOURS = {
    'wall': (0.42, 0.47, 0.56, 1.0),
    'barrier': (0.55, 0.42, 0.60, 1.0),
    'door': (0.45, 0.27, 0.12, 1.0),
    'pad': (0.95, 0.55, 0.10, 1.0),
    'pressed_pad': (0.15, 0.75, 0.30, 1.0),
    'plate': (0.30, 0.30, 0.33, 1.0),
    'apple': (0.85, 0.12, 0.12, 1.0),
    'large_apple': (0.98, 0.80, 0.10, 1.0),
    'avatar': (0.92, 0.92, 0.95, 1.0),
}

# Colours of the base block and the offset block of a register, by its role.
ROLE_COLOURS = {
    'feedback': ((0.10, 0.25, 0.70, 1.0), (0.35, 0.65, 1.00, 1.0)),
    'meter': ((0.45, 0.10, 0.55, 1.0), (0.80, 0.45, 0.95, 1.0)),
    'query': ((0.05, 0.45, 0.40, 1.0), (0.30, 0.85, 0.75, 1.0)),
    'signal': ((0.35, 0.35, 0.05, 1.0), (0.80, 0.80, 0.30, 1.0)),
    'memory': ((0.45, 0.20, 0.05, 1.0), (0.95, 0.60, 0.35, 1.0)),
}


def code(name: str) -> int:
  """Returns the code that the ray sense reports for the class `name`.

  Args:
    name: One of `CLASSES`.
  """
  return CLASSES.index(name)


def geom_style(name: str, rgba: Any = None) -> dict[str, Any]:
  """Returns geom attributes for a geom of the class `name`.

  The class code is stored as the geom's `user` number, so it can be read from
  any compiled model without its entities.

  Args:
    name: One of `CLASSES`.
    rgba: Colour; `None` for the colour of the class.
  """
  return {
      'user': [code(name)],
      'rgba': COLOURS[name] if rgba is None else rgba,
  }


def class_of_geoms(model: Any) -> np.ndarray:
  """Returns the class code of every geom of a compiled model, `(ngeom,)` int32.

  Geoms without a class, such as those of other packages, are `other`.
  """
  if not model.nuser_geom:
    return np.full(model.ngeom, code('other'), np.int32)
  codes = np.array(model.geom_user[:, 0], np.int32)
  codes[(codes <= 0) | (codes >= len(CLASSES))] = code('other')
  return codes

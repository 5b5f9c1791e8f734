"""Contacts of the blocks of registers."""

from typing import Any

# Contacts between blocks are soft, so that a block that is written into another
# one pushes it away slowly: at 1.3 m/s at most, compared with 9.8 m/s at
# MuJoCo's default stiffness. In contacts with other geoms, the stiffness of the
# other geom counts, because a block on a soft floor settles so slowly after a
# write that its value drifts (by 3e-8 m instead of 2e-15 m).
_CONTACT: dict[str, Any] = {
    'friction': (0.8, 0.01, 0.001),
    'solref': (0.06, 1.0),
    'solmix': 1e-4,
}
# Bodies can penetrate a large block more deeply and would then be pushed out
# faster: at up to 2.6 m/s by a cube of 0.4 m. Above this half edge length, in
# m, contacts of a block become softer as its size increases.
_USUAL_HALF_SIZE = 0.1
# Exponent by which the friction of large blocks decreases with their softness.
# MuJoCo's contacts turn sliding into hopping: a cube of 1 m that was squeezed
# against a wall hopped off another one at 5.4 m/s. The fastest of 800 such
# cubes left at 3.0 m/s with exponent 2, 2.6 with 3, 2.0 with 4 and 1.95 with 6.
_SLIPPERINESS = 6


def softness(half_size: float) -> float:
  """Returns the factor by which contacts of a block are softened, at least 1.

  Args:
    half_size: Half the edge length of the block, in m.
  """
  return max(1.0, half_size / _USUAL_HALF_SIZE)


def attributes(half_size: float) -> dict[str, Any]:
  """Returns the contact attributes of a block.

  Args:
    half_size: Half the edge length, in m.
  """
  soft = softness(half_size)
  time, damping = _CONTACT['solref']
  slide, spin, roll = _CONTACT['friction']
  return {
      **_CONTACT,
      'solref': (time * soft, damping),
      'friction': (slide / soft**_SLIPPERINESS, spin, roll),
  }

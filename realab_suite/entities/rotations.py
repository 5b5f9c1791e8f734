"""Rotations about the vertical, and quaternions."""

from typing import Any

import numpy as np

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def matrices(quaternion: np.ndarray) -> np.ndarray:
  """Returns the matrices, `(..., 3, 3)`, of quaternions, `(..., 4)`."""
  w, x, y, z = [quaternion[..., i] for i in range(4)]
  rows = [
      [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
  ]
  return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def heading_of(quaternion: np.ndarray) -> np.ndarray:
  """Returns the angles of quaternions, `(..., 4)`, about the vertical.

  It is the angle by which the horizontal diagonal of a cube has turned, seen
  from above. A rotation about the vertical changes it by the angle of the
  rotation, however the cube is tilted. Every such angle is undefined at some
  tilt: this one where the cube balances on an edge, not where it lies on a
  face, as the twist about the vertical would be for a cube upside down.
  """
  w, x, y, z = [quaternion[..., i][()] for i in range(4)]
  east = w * w + x * x - y * y - z * z + 2.0 * (x * y - w * z)
  north = w * w - x * x + y * y - z * z + 2.0 * (x * y + w * z)
  # The diagonal of an unturned cube is at 45 degrees.
  return np.arctan2(north - east, north + east)


def turned(turn: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
  """Returns quaternions, `(..., 4)`, turned about the vertical.

  Args:
    turn: Quaternions of rotations about the vertical, `(..., 4)`.
    quaternion: Quaternions to turn, `(..., 4)`.
  """
  cos, sin = turn[..., 0], turn[..., 3]
  w, x, y, z = [quaternion[..., i] for i in range(4)]
  return np.stack(
      [
          cos * w - sin * z,
          cos * x - sin * y,
          cos * y + sin * x,
          cos * z + sin * w,
      ],
      axis=-1,
  )


def quaternion_of(angle: Any) -> np.ndarray:
  """Returns the quaternions, `(..., 4)`, of rotations about the vertical."""
  if angle is None:
    return UPRIGHT
  half = np.asarray(angle, float) / 2.0
  quaternion = np.zeros((*half.shape, 4))
  quaternion[..., 0] = np.cos(half)
  quaternion[..., 3] = np.sin(half)
  return quaternion

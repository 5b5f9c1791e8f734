"""Lines of sight from a point that is fixed in the world to fixed places."""

from typing import Any, NamedTuple, final

from dm_control import mjcf
import numpy as np

from realab_suite.entities import protocols
from realab_suite.entities import rays

# In place of the numbers of directions that are 0.
_TINY = 1e-12


@final
class Look(NamedTuple):
  """What is seen along lines of sight.

  Attributes:
    seen: True where something is nearer than the place, `(..., lines)` bool.
    geoms: Geom that a line meets first; -1 for none, `(..., lines)`.
  """

  seen: np.ndarray
  geoms: np.ndarray


@final
class Sight:
  """Lines of sight of a register, from its reading point."""

  def __init__(
      self,
      mjcf_model: mjcf.RootElement,
      point: np.ndarray,
      places: np.ndarray,
  ) -> None:
    """Adds the point to the model of the register.

    Args:
      mjcf_model: Model of the register.
      point: Point, relative to the start of the first block in x and y, `(3,)`,
        in m.
      places: Places to look at, likewise, `(lines, 3)`, in m.
    """
    self._point = point
    # It marks the frame of the register, which the model has no other name of.
    self._site = mjcf_model.worldbody.add(
        'site', name='reading_point', pos=point, size=[0.03], group=4
    )
    ways = places - point
    self._lengths = np.linalg.norm(ways, axis=-1)
    self._ways = ways / self._lengths[:, np.newaxis]

  def look(self, physics: protocols.Physics, start: np.ndarray) -> Look:
    """Looks along the lines.

    Args:
      physics: One world or a batch of worlds.
      start: Position of the first block at the start, `(..., 3)`, in m.
    """
    site = physics.bind(self._site)
    turn = np.reshape(site.xmat, (*site.xmat.shape[:-1], 3, 3))
    shift = np.array(start)
    shift[..., 2] = 0.0
    point = site.xpos + turned(turn, shift)
    ways = self._ways @ np.swapaxes(turn, -1, -2)
    distances, geoms = rays.cast(physics, point, ways, -1)
    return Look((distances >= 0.0) & (distances <= self._lengths), geoms)

  def meets(
      self,
      start: np.ndarray,
      position: np.ndarray,
      turn: np.ndarray,
      centres: np.ndarray,
      halves: np.ndarray,
  ) -> np.ndarray:
    """Returns where boxes are nearer than the places, `(..., lines)` bool.

    Args:
      start: As in `look`.
      position: Origin of the frame of the boxes in that of the register,
        `(..., 3)`, in m.
      turn: Axes of that frame, as columns, `(..., 3, 3)`.
      centres: Centres of the boxes in that frame, `(..., boxes, 3)`, in m.
      halves: Half their edge lengths, `(boxes, 3)`, in m.
    """
    point = self._point - position
    point[..., :2] += start[..., :2]
    point = turned(np.swapaxes(turn, -1, -2), point)
    ways = self._ways @ turn
    ways = np.where(np.abs(ways) < _TINY, _TINY, ways)[..., np.newaxis, :]
    offsets = centres - point[..., np.newaxis, :]
    middle = offsets[..., np.newaxis, :, :] / ways
    half = halves / np.abs(ways)
    enters = (middle - half).max(axis=-1)
    leaves = (middle + half).min(axis=-1)
    is_met = (enters <= leaves) & (leaves > 0.0)
    distances = np.where(is_met, enters, np.inf).min(axis=-1)
    return np.asarray(distances <= self._lengths)


def turned(turn: np.ndarray, vector: Any) -> np.ndarray:
  """Returns vectors, `(..., 3)`, turned by matrices, `(..., 3, 3)`."""
  return np.einsum('...ij,...j->...i', turn, vector)

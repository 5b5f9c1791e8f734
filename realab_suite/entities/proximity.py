"""Distances between the surfaces of geoms, for one world and for a batch.

A batch of worlds has no list of contacts. Contacts are therefore computed from
the positions of geoms, in the same way for one world and for a batch.
"""

from collections.abc import Sequence
import itertools
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import protocols

# Displacements for repeated queries, in m. Their direction is not parallel or
# perpendicular to usual faces.
_NUDGES = np.outer([0.0, 1e-5, 5e-5], [0.36, 0.48, 0.8])

# Data of each compiled model to put geoms into, because the physics of a batch
# has no `mjData` of a single world.
_data: weakref.WeakKeyDictionary[Any, mujoco.MjData] = (
    weakref.WeakKeyDictionary()
)


@final
class Proximity:
  """Detects whether the surfaces of two sets of geoms are close together."""

  def __init__(
      self,
      ones: Sequence[mjcf.Element],
      others: Sequence[mjcf.Element],
      limit: float,
  ) -> None:
    """Initializes the detector.

    Args:
      ones: Geoms of one kind: no planes and no height fields.
      others: Geoms to detect near them.
      limit: Largest distance that counts as close, in m.
    """
    self._geoms = (*ones, *others)
    self._pairs = np.array(
        list(
            itertools.product(
                range(len(ones)), range(len(ones), len(self._geoms))
            )
        )
    )
    self._limit = limit

  def __call__(self, physics: protocols.Physics) -> np.ndarray:
    """Returns True in each world with a close pair of geoms, `(...)` bool."""
    bound = physics.bind(self._geoms)
    geoms = np.asarray(bound.element_id)
    centres, matrices = np.asarray(bound.xpos), np.asarray(bound.xmat)
    worlds = centres.shape[:-2]
    radii = physics.model.geom_rbound[geoms]
    first, second = self._pairs.T
    offsets = centres[..., first, :] - centres[..., second, :]
    reach = radii[first] + radii[second] + self._limit
    is_near = (offsets * offsets).sum(axis=-1) <= reach**2
    close = np.zeros(worlds, bool)
    model = physics.model
    # In most steps, no pair is near in most worlds.
    for *world, pair in np.argwhere(is_near):
      where = tuple(world)
      if not close[where]:
        if model not in _data:
          _data[model] = mujoco.MjData(model.ptr)
        near = self._pairs[pair]
        gap, _ = distance(
            model.ptr,
            _data[model],
            geoms[near],
            centres[where][near],
            matrices[where][near],
            2.0 * self._limit + 0.01,
        )
        close[where] = gap <= self._limit
    return close[()]


def distance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    geoms: Sequence[int] | np.ndarray,
    centres: Any,
    matrices: Any,
    limit: float,
) -> tuple[float, np.ndarray]:
  """Returns the distance of the surfaces of two geoms, in m.

  Args:
    model: Compiled model.
    data: Data of the model, into which the geoms are put.
    geoms: Numbers of the geoms in the model, `(2,)`.
    centres: Their positions, `(2, 3)`, in m.
    matrices: Their orientations, `(2, 9)`.
    limit: Distance, in m, above which the result may be any larger number.

  Returns:
    The distance, which is 0 if MuJoCo cannot compute it, and the point between
    the surfaces, `(3,)`, in m.
  """
  first, second = map(int, geoms)
  ends = np.zeros(6)
  for geom, centre, matrix in zip(geoms, centres, matrices, strict=True):
    data.geom_xpos[geom], data.geom_xmat[geom] = centre, matrix
  for nudge in _NUDGES:
    data.geom_xpos[first] = centres[0] + nudge
    gap = mujoco.mj_geomDistance(model, data, first, second, limit, ends)
    # MuJoCo also returns exactly 0 if it fails to compute the distance.
    if gap:
      return float(gap), (ends[:3] + ends[3:]) / 2
  return 0.0, np.array(centres[0])

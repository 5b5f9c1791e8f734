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

# Displacement for a repeated query, in m.
_NUDGE = 1e-5

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
    one, other = self._pairs.T
    offsets = centres[..., one, :] - centres[..., other, :]
    reach = radii[one] + radii[other] + self._limit
    is_near = (offsets * offsets).sum(axis=-1) <= reach**2
    close = np.zeros(worlds, bool)
    # In most steps, no pair is near in most worlds.
    for *world, pair in np.argwhere(is_near):
      where = tuple(world)
      if not close[where]:
        near = self._pairs[pair]
        close[where] = distance(
            physics.model, geoms[near], centres[where][near],
            matrices[where][near], self._limit,
        ) <= self._limit  # fmt: skip
    return close[()]


def distance(
    model: Any,
    geoms: np.ndarray,
    centres: np.ndarray,
    matrices: np.ndarray,
    limit: float,
) -> float:
  """Returns the distance of the surfaces of two geoms, in m.

  Args:
    model: Compiled model, as `physics.model`.
    geoms: Numbers of the geoms in the model, `(2,)`.
    centres: Their positions, `(2, 3)`, in m.
    matrices: Their orientations, `(2, 9)`.
    limit: Distance, in m, above which the result may be any larger number.
  """
  if model not in _data:
    _data[model] = mujoco.MjData(model.ptr)
  data = _data[model]
  data.geom_xpos[geoms], data.geom_xmat[geoms] = centres, matrices
  one, other = geoms.tolist()
  found = 0.0
  for nudge in (0.0, _NUDGE):
    # MuJoCo also returns exactly 0 if it fails to compute the distance.
    if not found:
      data.geom_xpos[one] = centres[0] + nudge
      found = mujoco.mj_geomDistance(
          model.ptr, data, one, other, 2.0 * limit + 0.01, None
      )
  return float(found)

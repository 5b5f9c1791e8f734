"""Checks that blocks above the floor stand on something that stays in place.

A surface carries a block if it is under the centre of the block. A set of poses
is carried by a convex geom if its extreme poses are, so that no poses between
them have to be sampled.
"""

from typing import final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import solids

# Largest height of a block above the surface that carries it, in metres. It
# exceeds the gap under a planar block.
_GAP = 0.01
_DOWN = np.array([0.0, 0.0, -1.0])


@final
class Surfaces:
  """Solid geoms of a world that stay in place."""

  def __init__(self, physics: mjcf.Physics) -> None:
    """Collects the geoms of a physics in its present state."""
    model = physics.model
    is_solid = (model.geom_contype | model.geom_conaffinity) != 0
    bodies = model.body_weldid[model.geom_bodyid]
    is_fixed = (bodies == 0) & (model.body_mocapid[model.geom_bodyid] < 0)
    self._model, self._data = model.ptr, physics.data.ptr
    self._geoms = np.flatnonzero(is_solid & is_fixed).tolist()

  def find_unsupported(self, region: solids.Region) -> np.ndarray | None:
    """Returns a position above the floor that no one surface carries, `(3,)`.

    Args:
      region: Poses of a block.

    Returns:
      A position of its centre, in m; `None` if a surface carries all of them.
    """
    half = region.half_size
    points = np.unique(region.corners().round(9), axis=0)
    if points[:, 2].min() - half <= _GAP:
      return None
    unsupported = [
        [p for p in points if not self._is_over(geom, p, half)]
        for geom in self._geoms
    ]
    missing = min(unsupported, key=len, default=list(points))
    return missing[0] if missing else None

  def _is_over(self, geom: int, point: np.ndarray, half: float) -> bool:
    """Returns True if a geom is close under a block with its centre here."""
    model, data = self._model, self._data
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SDF:
      return False
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
      below = mujoco.mj_rayMesh(model, data, geom, point, _DOWN, None)
    elif kind == mujoco.mjtGeom.mjGEOM_HFIELD:
      below = mujoco.mj_rayHfield(model, data, geom, point, _DOWN, None)
    else:
      below = mujoco.mju_rayGeom(
          data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom],
          point, _DOWN, kind, None,
      )  # fmt: skip
    return 0.0 <= below <= half + _GAP

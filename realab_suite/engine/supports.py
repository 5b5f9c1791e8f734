"""Checks that blocks above the floor stand on something that stays in place.

A surface carries a block if it is under the centre of the block. A set of poses
is carried by a convex geom if its extreme poses are, so that no poses between
them have to be sampled.
"""

import itertools
from typing import final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import swept_volumes

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

  def find_unsupported(
      self, sweep: swept_volumes.Sweep
  ) -> swept_volumes.Sweep | None:
    """Returns a pose above the floor that no one surface carries, or `None`.

    Args:
      sweep: Poses of the geom of a block.
    """
    half = float(self._model.geom_size[sweep.geom][2])
    if sweep.centre[2] - half <= _GAP:
      return None
    poses = [
        sweep.pose(np.array(sides))
        for sides in itertools.product((-1.0, 1.0), repeat=len(sweep.motions))
    ]
    # Poses may differ from these in any direction.
    offsets = sweep.slack * np.vstack([np.eye(3)[:2], -np.eye(3)[:2]])
    points = np.array(
        [pose.centre + offset for pose in poses for offset in offsets]
    )
    points = np.unique(points.round(9), axis=0)
    unsupported = [
        [p for p in points if not self._is_over(geom, p, half)]
        for geom in self._geoms
    ]
    missing = min(unsupported, key=len, default=list(points))
    if not missing:
      return None
    return min(poses, key=lambda pose: np.linalg.norm(pose.centre - missing[0]))

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

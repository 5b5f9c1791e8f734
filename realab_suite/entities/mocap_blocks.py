"""Blocks of welded registers, which only writes can move."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import block_contacts
from realab_suite.entities import block_kinds
from realab_suite.entities import moving
from realab_suite.entities import protocols
from realab_suite.entities import rotations


@final
class MocapBlock(block_kinds.Block):
  """A block of a welded register, which only writes can move."""

  def __init__(
      self,
      name: str,
      position: Sequence[float],
      half_size: float,
      style: dict[str, Any],
  ) -> None:
    """Makes a block that is not yet attached; see `attach_to`.

    Args:
      name: Name of the part.
      position: Position at rest in the register's frame, `(x, y)`, in m.
      half_size: Half the edge length, in m.
      style: Geom attributes; see `appearance.geom_style`.
    """
    super().__init__(half_size)
    self._rest = np.array([*position, half_size])
    self._part = moving.MovingPart(
        name,
        [
            {
                'type': 'box',
                'size': [half_size] * 3,
                **block_contacts.attributes(half_size),
                **style,
            }
        ],
    )
    self._origin = np.zeros(3)
    self._yaw = 0.0

  @property
  def body(self) -> mjcf.Element | None:
    return self._part.frame

  @property
  def geom(self) -> mjcf.Element:
    return self._part.geoms[0]

  @property
  def rest_height(self) -> float:
    return self._half_size

  def attach_to(
      self, root: composer.Entity, position: Sequence[float], yaw: float
  ) -> None:
    """Attaches the block to the root entity of a task.

    Args:
      root: Root entity of the task.
      position: Origin of the register's frame, `(x, y, z)`, in m.
      yaw: Angle of the register's axis to the x axis of the world, in rad.
    """
    self._origin = np.array(position, float)
    self._yaw = yaw
    frame = self._part.attach_to(root, list(self._to_world(self._rest)))
    frame.quat = rotations.quaternion_of(yaw)

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    self._part.detach()

  def position(self, physics: protocols.Physics) -> np.ndarray:
    position = np.asarray(physics.bind(self._part.frame).mocap_pos)
    return rotations.rotate(position - self._origin, -self._yaw)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    angle = (
        rotations.heading_of(physics.bind(self._part.frame).mocap_quat)
        - self._yaw
    )
    return np.arctan2(np.sin(angle), np.cos(angle))

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    turned = 0.0 if heading is None else np.asarray(heading)
    moving.move(
        physics,
        self._part.frame,
        self._to_world(np.asarray(position)),
        rotations.quaternion_of(turned + self._yaw),
        where,
    )

  def _to_world(self, position: np.ndarray) -> np.ndarray:
    return self._origin + rotations.rotate(position, self._yaw)

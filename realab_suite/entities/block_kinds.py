"""Blocks: cubes whose poses store the values of registers.

The position and heading of a block are given in the frame of its register,
whose x axis carries the value. A free block can be moved in six degrees of
freedom, a planar block only along the floor, and a mocap block (of a welded
register) only by writes.
"""

import abc
from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import moving
from realab_suite.entities import protocols

# Smallest edge length of a block in a design, in m. A thrown block lands at up
# to 2.8 m/s, which is 28 mm in a substep of 10 ms. The centre of a block with
# less than twice that edge length would be below the floor after the substep.
LEAST_SIZE = 0.06
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
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
# Height at which an avatar carries a block, in m.
GRIP_HEIGHT = 0.2
# Gap between a planar block and the floor, in m, so that they never touch.
_HOVER = 0.004
# Friction loss of the joints of a planar block, in N, in place of contact with
# the floor.
_PLANAR_FRICTION = 6.0


def softness(half_size: float) -> float:
  """Returns the factor by which contacts of a block are softened, at least 1.

  Args:
    half_size: Half the edge length of the block, in m.
  """
  return max(1.0, half_size / _USUAL_HALF_SIZE)


class Block(abc.ABC):
  """Base class for the blocks of registers."""

  def __init__(self, half_size: float) -> None:
    self._half_size = half_size
    self._grasps: list[mjcf.Element] = []

  @property
  def half_size(self) -> float:
    """Half the edge length, in m."""
    return self._half_size

  @property
  @abc.abstractmethod
  def geom(self) -> mjcf.Element:
    """Geom of the cube."""

  @property
  @abc.abstractmethod
  def rest_height(self) -> float:
    """Height of the centre of a block that rests on the floor, in m."""

  @property
  def grasps(self) -> list[mjcf.Element]:
    """Equality constraints by which hands can hold the block."""
    return self._grasps

  @abc.abstractmethod
  def position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the centre in the register's frame, `(..., 3)`, in m."""

  def along(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the x coordinate in the register's frame, `(...)`, in m."""
    return axes.component(self.position(physics), 0)

  @abc.abstractmethod
  def heading(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle about the vertical, `(...)`, in (-pi, pi]."""

  @abc.abstractmethod
  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    """Teleports the block to a pose, upright and at rest, and releases it.

    Args:
      physics: One world or a batch of worlds.
      position: Centre in the register's frame, `(..., 3)`, in m.
      heading: Angle about the vertical, `(...)`, in rad; `None` for 0.
      where: Worlds in which to do so, `(...)` bool; `None` for all worlds.
    """

  def let_go(self, physics: protocols.Physics, where: axes.Mask = None) -> None:
    """Releases the block from every hand.

    Otherwise a teleport of the block would pull the hand along.

    Args:
      physics: One world or a batch of worlds.
      where: As in `put`.
    """
    if self._grasps:
      axes.assign(physics.bind(self._grasps), 'active', 0, where)


class JointedBlock(Block):
  """Base class for blocks with joints of their own in the register's model.

  A free joint would be simpler, but MuJoCo accepts free joints only on children
  of the world, and a register must remain one subtree that can be attached to
  any entity.
  """

  # Joints that translate the block, in the order of the axes.
  _slides: tuple[mjcf.Element, ...]

  def __init__(
      self,
      mjcf_model: mjcf.RootElement,
      name: str,
      position: Sequence[float],
      half_size: float,
      mass: float,
      style: dict[str, Any],
  ) -> None:
    """Adds the block to the model of a register.

    Args:
      mjcf_model: Model of the register.
      name: Name of the body; the names of its joints begin with it.
      position: Position at rest, `(x, y)`, in m.
      half_size: Half the edge length, in m.
      mass: Mass, in kg.
      style: Geom attributes; see `appearance.geom_style`.
    """
    super().__init__(half_size)
    self._rest = np.array([*position, self.rest_height])
    self._body = mjcf_model.worldbody.add('body', name=name, pos=self._rest)
    self._geom = self._body.add(
        'geom', name=name, type='box', size=[half_size] * 3, mass=mass,
        **_contact(half_size), **style
    )  # fmt: skip
    self._site = self._body.add(
        'site', name=f'{name}_grip', size=[0.01], group=4,
        pos=[0.0, 0.0, self._grip_offset],
    )  # fmt: skip

  @property
  @abc.abstractmethod
  def _grip_offset(self) -> float:
    """Height of the grip above the centre of the block, in m."""

  @property
  def body(self) -> mjcf.Element:
    return self._body

  @property
  def geom(self) -> mjcf.Element:
    return self._geom

  @property
  def site(self) -> mjcf.Element:
    """Site that a hand grasps."""
    return self._site

  def along(self, physics: protocols.Physics) -> np.ndarray:
    moved = physics.bind(self._slides).qpos
    return self._rest[0] + axes.component(moved, 0)

  def launch(
      self, physics: protocols.Physics, velocity: np.ndarray, where: Any
  ) -> None:
    """Sets the velocity of the block in some worlds.

    Args:
      physics: One world or a batch of worlds.
      velocity: Velocity in the world frame, `(..., 3)`, in m/s.
      where: True for each world in which to set it, `(...)` bool.
    """
    slides = self._slides
    # The slides are parallel to the axes of the register, not of the world.
    frame = mjcf.get_attachment_frame(self._body.root)
    if frame is not None:
      velocity = np.einsum(
          '...ji,...j->...i',
          np.reshape(physics.bind(frame).xmat, (*velocity.shape[:-1], 3, 3)),
          velocity,
      )
    bound = physics.bind(slides)
    bound.qvel = np.where(
        np.asarray(where)[..., np.newaxis],
        velocity[..., : len(slides)],
        bound.qvel,
    )


@final
class FreeBlock(JointedBlock):
  """A block that can be pushed, lifted, carried, thrown and toppled."""

  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    name = self._body.name
    self._slides = tuple(
        self._body.add(
            'joint', name=f'{name}_{axis}', type='slide', axis=vector
        )
        for axis, vector in zip('xyz', np.eye(3), strict=True)
    )
    self._rotation = self._body.add('joint', name=f'{name}_ball', type='ball')
    self._joints = (*self._slides, self._rotation)

  @property
  def rest_height(self) -> float:
    return self._half_size

  @property
  def _grip_offset(self) -> float:
    return 0.0  # A grasp lifts the block to the hand.

  def position(self, physics: protocols.Physics) -> np.ndarray:
    return self._rest + np.asarray(physics.bind(self._slides).qpos)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    return _heading(physics.bind(self._rotation).qpos)

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    self.let_go(physics, where)
    moved, turned = np.subtract(position, self._rest), _quaternion(heading)
    axes.assign(physics.bind(self._slides), 'qpos', moved, where)
    axes.assign(physics.bind(self._rotation), 'qpos', turned, where)
    axes.assign(physics.bind(self._joints), 'qvel', 0.0, where)


@final
class PlanarBlock(JointedBlock):
  """A block that slides and turns along the floor and is never lifted.

  It is cheaper to simulate than a free block.
  """

  def __init__(self, *args: Any, **kwargs: Any) -> None:
    super().__init__(*args, **kwargs)
    name = self._body.name
    loss = {'frictionloss': _PLANAR_FRICTION}
    self._slides = tuple(
        self._body.add(
            'joint', name=f'{name}_{axis}', type='slide', axis=vector, **loss
        )
        for axis, vector in zip('xy', np.eye(3)[:2], strict=True)
    )
    self._hinge = self._body.add(
        'joint', name=f'{name}_hinge', type='hinge', axis=(0, 0, 1),
        frictionloss=_PLANAR_FRICTION * self._half_size / 2,
    )  # fmt: skip
    self._joints = (*self._slides, self._hinge)

  @property
  def rest_height(self) -> float:
    return self._half_size + _HOVER

  @property
  def _grip_offset(self) -> float:
    # A grip at another height would pull in a direction without a joint.
    return GRIP_HEIGHT - self.rest_height

  def position(self, physics: protocols.Physics) -> np.ndarray:
    moved = np.asarray(physics.bind(self._slides).qpos)
    planar = self._rest[:2] + moved
    height = np.full((*planar.shape[:-1], 1), self._rest[2])
    return np.concatenate([planar, height], axis=-1)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    angle = axes.component(physics.bind(self._hinge).qpos, 0)
    return np.arctan2(np.sin(angle), np.cos(angle))

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    self.let_go(physics, where)
    moved = np.asarray(position)[..., :2] - self._rest[:2]
    angle = 0.0 if heading is None else np.asarray(heading)[..., np.newaxis]
    axes.assign(physics.bind(self._slides), 'qpos', moved, where)
    axes.assign(physics.bind(self._hinge), 'qpos', angle, where)
    axes.assign(physics.bind(self._joints), 'qvel', 0.0, where)


@final
class MocapBlock(Block):
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
                **_contact(half_size),
                **style,
            }
        ],
    )
    self._origin = np.zeros(3)
    self._yaw = 0.0

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
      position: Origin of the register's frame, `(x, y)`, in m.
      yaw: Angle of the register's axis to the x axis of the world, in rad.
    """
    self._origin = np.array([*position, 0.0])
    self._yaw = yaw
    frame = self._part.attach_to(root, list(self._to_world(self._rest)))
    frame.quat = _quaternion(yaw)

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    self._part.detach()

  def position(self, physics: protocols.Physics) -> np.ndarray:
    position = np.asarray(physics.bind(self._part.frame).mocap_pos)
    return _rotate(position - self._origin, -self._yaw)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    angle = _heading(physics.bind(self._part.frame).mocap_quat) - self._yaw
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
        _quaternion(turned + self._yaw),
        where,
    )

  def _to_world(self, position: np.ndarray) -> np.ndarray:
    return self._origin + _rotate(position, self._yaw)


def _contact(half_size: float) -> dict[str, Any]:
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


def _rotate(vector: np.ndarray, angle: float) -> np.ndarray:
  """Rotates vectors, `(..., 3)`, about the vertical by an angle in rad."""
  if not angle:
    return vector
  cos, sin = np.cos(angle), np.sin(angle)
  x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
  return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def _heading(quaternion: np.ndarray) -> np.ndarray:
  """Returns the angles of quaternions, `(..., 4)`, about the vertical."""
  w, x, y, z = (axes.component(quaternion, i) for i in range(4))
  return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _quaternion(angle: Any) -> np.ndarray:
  """Returns the quaternions, `(..., 4)`, of rotations about the vertical."""
  if angle is None:
    return _UPRIGHT
  half = np.asarray(angle, float) / 2.0
  quaternion = np.zeros((*half.shape, 4))
  quaternion[..., 0] = np.cos(half)
  quaternion[..., 3] = np.sin(half)
  return quaternion

"""Blocks: the cubes in whose poses registers keep their values.

A block's position and heading are given in the frame of its register, whose x
axis is the one that carries the value. Three kinds differ in what can move
them: a free block in six degrees of freedom, a planar block along the floor, a
mocap block (of a welded register) not at all.
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

# The least edge of a block in a design, metres. What an avatar throws lands at
# up to 2.8 m/s, 28 mm in a substep of 10 ms: the middle of a block of less than
# twice that would be under the floor at first.
LEAST_SIZE = 0.06
# Blocks are soft to each other, so that one that is written into another pushes
# it away slowly: at 1.3 m/s at most, where MuJoCo's own stiffness gave 9.8 m/s.
# Against anything else the stiffness of the other thing counts, because a block
# on a soft floor takes so long to settle after a write that its value drifts
# (3e-8 m instead of 2e-15).
_CONTACT: dict[str, Any] = {
    'friction': (0.8, 0.01, 0.001),
    'solref': (0.06, 1.0),
    'solmix': 1e-4,
}
# The larger a block is, the deeper another thing can be in it, and the faster
# it would be pushed out: at up to 2.6 m/s, for a cube of 0.4 m. From this size
# on, half of an edge in metres, blocks are the softer, the larger they are.
_USUAL_HALF_SIZE = 0.1
# Large blocks also grip each other less. MuJoCo's contacts turn sliding into
# hopping, and a cube of 1 m that is squeezed against a wall hopped off another
# one at 5.4 m/s. Of the powers that were tried, the fastest of 800 such cubes
# left at 3.0 (2), 2.6 (3), 2.0 (4) and 1.95 m/s (6).
_SLIPPERINESS = 6
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
# The height at which an avatar carries a block, metres.
GRIP_HEIGHT = 0.2
# A planar block hovers, so that it never touches the floor.
_HOVER = 0.004
# What a planar block loses to the floor that it does not touch.
_PLANAR_FRICTION = 6.0


def softness(half_size: float) -> float:
  """Returns how much slower a block is pushed out than a usual one, >= 1."""
  return max(1.0, half_size / _USUAL_HALF_SIZE)


class Block(abc.ABC):
  """A cube of a register."""

  def __init__(self, half_size: float) -> None:
    self._half_size = half_size
    self._grasps: list[mjcf.Element] = []

  @property
  def half_size(self) -> float:
    """Half the length of an edge, in metres."""
    return self._half_size

  @property
  @abc.abstractmethod
  def geom(self) -> mjcf.Element:
    """The cube."""

  @property
  @abc.abstractmethod
  def rest_height(self) -> float:
    """The height of the centre when the block rests on the floor, metres."""

  @property
  def grasps(self) -> list[mjcf.Element]:
    """The equality constraints by which hands can hold this block."""
    return self._grasps

  @abc.abstractmethod
  def position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the centre in the register's frame, shape `(..., 3)`, metres."""

  def along(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the centre's place along the register's axis, `(...)`, metres."""
    return axes.component(self.position(physics), 0)

  @abc.abstractmethod
  def heading(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle about the vertical, shape `(...)`, in (-pi, pi]."""

  @abc.abstractmethod
  def put(
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    """Teleports the block, upright and at rest, and makes hands let go of it.

    Args:
      physics: One world, or many.
      position: The centre in the register's frame, shape `(..., 3)`, metres.
      heading: The angle about the vertical, shape `(...)`, radians; `None`
        for 0.
    """

  def let_go(self, physics: protocols.Physics) -> None:
    """Makes every hand let go of the block.

    A hand that still held the block would be yanked along by a teleport.
    """
    if self._grasps:
      physics.bind(self._grasps).active = 0


class JointedBlock(Block):
  """A block that hangs from joints of its own in its register's model.

  A free joint would be simpler, but MuJoCo only accepts free joints on children
  of the world, and a register has to stay one subtree that can be attached
  anywhere.
  """

  # The joints that translate the block, in the order of the axes.
  _slides: tuple[mjcf.Element, ...]

  def __init__(
      self,
      mjcf_model: mjcf.RootElement,
      name: str,
      position: Sequence[float],
      half_size: float,
      mass: float,
      looks: dict[str, Any],
  ) -> None:
    """Adds the block to the model of a register.

    Args:
      mjcf_model: The model of the register.
      name: The name of the body, which begins the names of its joints.
      position: Where the block stands at rest, `(x, y)` in metres.
      half_size: Half the length of an edge, metres.
      mass: In kilograms.
      looks: Geom attributes, see `appearance.geom_style`.
    """
    super().__init__(half_size)
    self._rest = np.array([*position, self.rest_height])
    self._body = mjcf_model.worldbody.add('body', name=name, pos=self._rest)
    self._geom = self._body.add(
        'geom', name=name, type='box', size=[half_size] * 3, mass=mass,
        **_contact(half_size), **looks
    )  # fmt: skip
    self._site = self._body.add(
        'site', name=f'{name}_grip', size=[0.01], group=4,
        pos=[0.0, 0.0, self._grip_offset],
    )  # fmt: skip

  @property
  @abc.abstractmethod
  def _grip_offset(self) -> float:
    """How far above the centre a hand takes hold, metres."""

  @property
  def body(self) -> mjcf.Element:
    return self._body

  @property
  def geom(self) -> mjcf.Element:
    return self._geom

  @property
  def site(self) -> mjcf.Element:
    """What a hand takes hold of."""
    return self._site

  def along(self, physics: protocols.Physics) -> np.ndarray:
    moved = physics.bind(self._slides).qpos
    return self._rest[0] + axes.component(moved, 0)

  def launch(
      self, physics: protocols.Physics, velocity: np.ndarray, where: Any
  ) -> None:
    """Gives the block a velocity.

    Args:
      physics: One world, or many.
      velocity: In the frame of the world, shape `(..., 3)`, metres per second.
      where: In which worlds, shape `(...)`, bool.
    """
    slides = self._slides
    # The slides run along the axes of the register, not of the world.
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
    return 0.0  # The block is lifted to the hand.

  def position(self, physics: protocols.Physics) -> np.ndarray:
    return self._rest + np.asarray(physics.bind(self._slides).qpos)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    return _heading(physics.bind(self._rotation).qpos)

  def put(
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    self.let_go(physics)
    physics.bind(self._slides).qpos = np.subtract(position, self._rest)
    physics.bind(self._rotation).qpos = _quaternion(heading)
    physics.bind(self._joints).qvel = 0.0


@final
class PlanarBlock(JointedBlock):
  """A block that slides and turns on the floor: cheaper, and never off it."""

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
    # A hand at another height would ask for a lift that the joints do not have.
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
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    self.let_go(physics)
    position = np.asarray(position)
    physics.bind(self._slides).qpos = position[..., :2] - self._rest[:2]
    physics.bind(self._hinge).qpos = (
        0.0 if heading is None else np.asarray(heading)[..., np.newaxis]
    )
    physics.bind(self._joints).qvel = 0.0


@final
class MocapBlock(Block):
  """A block of a welded register: it moves when written and never else."""

  def __init__(
      self,
      name: str,
      position: Sequence[float],
      half_size: float,
      looks: dict[str, Any],
  ) -> None:
    """Makes the block; `attach_to` puts it into a world.

    Args:
      name: The name of the part.
      position: Where the block stands at rest, `(x, y)` in the register's
        frame, metres.
      half_size: Half the length of an edge, metres.
      looks: Geom attributes, see `appearance.geom_style`.
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
                **looks,
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
    """Attaches the block to the root entity, for a register that stands there.

    Args:
      root: The root entity of the task.
      position: The origin of the register's frame, `(x, y)`, metres.
      yaw: The angle of the register's axis to the x axis of the world, radians.
    """
    self._origin = np.array([*position, 0.0])
    self._yaw = yaw
    frame = self._part.attach_to(root, list(self._to_world(self._rest)))
    frame.quat = _quaternion(yaw)

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    self._part.detach()

  def position(self, physics: protocols.Physics) -> np.ndarray:
    place = np.asarray(physics.bind(self._part.frame).mocap_pos)
    offset = place - self._origin
    return _rotate(offset, -self._yaw)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    angle = _heading(physics.bind(self._part.frame).mocap_quat) - self._yaw
    return np.arctan2(np.sin(angle), np.cos(angle))

  def put(
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    turned = 0.0 if heading is None else np.asarray(heading)
    moving.move(
        physics,
        self._part.frame,
        self._to_world(np.asarray(position)),
        _quaternion(turned + self._yaw),
    )

  def _to_world(self, position: np.ndarray) -> np.ndarray:
    return self._origin + _rotate(position, self._yaw)


def _contact(half_size: float) -> dict[str, Any]:
  """Returns what the contacts of a block of some size are like."""
  soft = softness(half_size)
  time, damping = _CONTACT['solref']
  slide, spin, roll = _CONTACT['friction']
  return {
      **_CONTACT,
      'solref': (time * soft, damping),
      'friction': (slide / soft**_SLIPPERINESS, spin, roll),
  }


def _rotate(vector: np.ndarray, angle: float) -> np.ndarray:
  """Turns vectors `(..., 3)` about the vertical."""
  if not angle:
    return vector
  cos, sin = np.cos(angle), np.sin(angle)
  x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
  return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def _heading(quaternion: np.ndarray) -> np.ndarray:
  """Returns the angle about the vertical of quaternions `(..., 4)`."""
  w, x, y, z = (axes.component(quaternion, i) for i in range(4))
  return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _quaternion(angle: Any) -> np.ndarray:
  """Returns the quaternions `(..., 4)` of rotations about the vertical."""
  if angle is None:
    return _UPRIGHT
  half = np.asarray(angle, float) / 2.0
  quaternion = np.zeros((*half.shape, 4))
  quaternion[..., 0] = np.cos(half)
  quaternion[..., 3] = np.sin(half)
  return quaternion

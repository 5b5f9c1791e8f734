"""Blocks: cubes whose poses store the values of registers.

The position and heading of a block are given in the frame of its register,
whose x axis carries the value. A free block can be moved in six degrees of
freedom, a planar block only along the floor, and a mocap block (of a welded
register) only by writes.
"""

import abc
from collections.abc import Iterable, Sequence
from typing import Any, final

from dm_control import mjcf
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import grasps
from realab_suite.entities import protocols
from realab_suite.entities import rotations
from realab_suite.entities import state
from realab_suite.entities import surroundings

# Smallest edge length of a block in a design, in m. A thrown block lands at up
# to 2.8 m/s, which is 28 mm in a substep of 10 ms. The centre of a block with
# less than twice that edge length would be below the floor after the substep.
LEAST_SIZE = 0.06
# Substeps, in s, and the half edge lengths, in m, of blocks for which the long
# one is reliable. With the long one, blocks of 6 cm were pushed into the floor
# of a corner, and cubes of more than 0.5 m left other ones at up to 3.3 m/s.
_SUBSTEP, _SHORT_SUBSTEP = 0.02, 0.01
_USUAL_SIZES = (0.075, 0.2)
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


def timestep_for(half_sizes: Iterable[float]) -> float:
  """Returns the duration of a substep of the physics, in s.

  Args:
    half_sizes: Half the edge length of each block in the world, in m.
  """
  low, high = _USUAL_SIZES
  is_usual = all(low <= half_size <= high for half_size in half_sizes)
  return _SUBSTEP if is_usual else _SHORT_SUBSTEP


class Block(abc.ABC):
  """Base class for the blocks of registers."""

  def __init__(self, half_size: float) -> None:
    self._half_size = half_size

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
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    """Teleports the block to a pose, upright and at rest, and releases it.

    Args:
      physics: One world or a batch of worlds.
      position: Centre in the register's frame, `(..., 3)`, in m.
      heading: Angle about the vertical, `(...)`, in rad; `None` for 0.
    """


class JointedBlock(Block):
  """Base class for blocks with joints of their own in the register's model.

  A free joint would be simpler, but MuJoCo accepts free joints only on children
  of the world, and a register must remain one subtree that can be attached to
  any entity.
  """

  # Joints that translate the block, in the order of the axes.
  _slides: tuple[mjcf.Element, ...]
  _joints: tuple[mjcf.Element, ...]

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
    self._grasps: list[grasps.Grasp] = []
    self._rest = np.array([*position, self.rest_height])
    self._body = mjcf_model.worldbody.add('body', name=name, pos=self._rest)
    self._geom = self._body.add(
        'geom', name=name, type='box', size=[half_size] * 3, mass=mass,
        **contact(half_size), **style
    )  # fmt: skip
    self._site = self._body.add(
        'site', name=f'{name}_grip', size=[0.01], group=4,
        pos=[0.0, 0.0, self._grip_offset],
    )  # fmt: skip

    self._surroundings = surroundings.Surroundings(
        self._body, self._rest, half_size
    )
    self._written_slot = state.Slot(mjcf_model, f'{name}_written')

  @property
  @abc.abstractmethod
  def _grip_offset(self) -> float:
    """Height of the grip above the centre of the block, in m."""

  @abc.abstractmethod
  def _orientation(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the orientation as a quaternion, `(..., 4)`."""

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

  @property
  def grasps(self) -> list[grasps.Grasp]:
    """Grasps by which hands can hold the block."""
    return self._grasps

  @property
  def surroundings(self) -> surroundings.Surroundings:
    """Frame of the register, and obstacles."""
    return self._surroundings

  @property
  def written_slot(self) -> state.Slot:
    """Slot that is 1 after a write while the block was held.

    A hand does not lose a block that a write has moved away from it.
    """
    return self._written_slot

  def along(self, physics: protocols.Physics) -> np.ndarray:
    moved = physics.bind(self._slides).qpos
    return self._rest[0] + axes.component(moved, 0)

  def slide(
      self,
      physics: protocols.Physics,
      along: np.ndarray,
  ) -> np.ndarray:
    """Sets the x coordinate in the register's frame, and nothing else.

    The block keeps its other coordinates, its orientation and its velocity, and
    a hand that holds it keeps hold. If the block would be inside an immovable
    object, it gets the nearest free coordinate.

    Args:
      physics: One world or a batch of worlds.
      along: Coordinate, `(...)`, in m.

    Returns:
      Coordinate that the block got, `(...)`, in m; `along` itself if no block
      was in the way of an obstacle.
    """
    position = self.position(physics)
    is_far = self._surroundings.are_far(physics, position)
    position[..., 0] = along
    if not axes.everywhere(is_far):
      along = self._free(physics, position, is_far)
      position[..., 0] = along
    physics.bind(self._slides[0]).qpos = np.subtract(along, self._rest[0])[
        ..., np.newaxis
    ]
    self._adapt_grasps(physics, position)
    return along

  @abc.abstractmethod
  def turn(self, physics: protocols.Physics, heading: np.ndarray) -> None:
    """Sets the angle about the vertical, and nothing else.

    Args:
      physics: One world or a batch of worlds.
      heading: Angle about the vertical, `(...)`, in rad.
    """

  def _free(
      self, physics: protocols.Physics, position: np.ndarray, is_far: Any
  ) -> np.ndarray:
    """Returns the free x coordinates nearest to those of `position`, `(...)`.

    Args:
      physics: One world or a batch of worlds.
      position: Wanted position in the register's frame, `(..., 3)`, in m.
      is_far: True where no obstacle is near, `(...)` bool.
    """
    along = np.array(position[..., 0])
    orientation = self._orientation(physics)
    for world in np.argwhere(~np.asarray(is_far)):
      index = tuple(world)
      along[index] = self._surroundings.nearest_free(
          position[index], surroundings.matrix(orientation[index])
      )
    return along[()]

  def _adapt_grasps(
      self, physics: protocols.Physics, position: np.ndarray
  ) -> None:
    """Tells the hands that a write has moved the block.

    Args:
      physics: One world or a batch of worlds.
      position: Position in the register's frame, `(..., 3)`, in m.
    """
    for grasp in self._grasps:
      if grasp.is_anywhere_held(physics):
        place = self._surroundings.in_world(physics, position)[..., :2]
        is_held = grasp.adapt(physics, place)
        # Not in other worlds of a batch, which must not depend on this one.
        was_held = self._written_slot.get(physics) > 0
        self._written_slot.set(physics, is_held | was_held)

  def _let_go(self, physics: protocols.Physics) -> None:
    """Releases the block from every hand.

    Otherwise a teleport of the block would pull the hand along.
    """
    for grasp in self._grasps:
      grasp.release(physics)
    if self._grasps:
      self._written_slot.set(physics, 0.0)

  def launch(
      self, physics: protocols.Physics, velocity: np.ndarray, where: Any
  ) -> None:
    """Sets the velocity of the block in some worlds.

    Args:
      physics: One world or a batch of worlds.
      velocity: Velocity in the world frame, `(..., 3)`, in m/s.
      where: True for each world in which to set it, `(...)` bool.
    """
    slides = physics.bind(self._slides)
    velocity = self._in_frame(physics, velocity)
    slides.qvel = np.where(
        np.asarray(where)[..., np.newaxis], velocity, slides.qvel
    )

  def slow_down(
      self, physics: protocols.Physics, velocity: np.ndarray, where: Any
  ) -> None:
    """Sets the velocity of the block in worlds in which it is faster.

    Args:
      physics: One world or a batch of worlds.
      velocity: Velocity in the world frame, `(..., 3)`, in m/s.
      where: True for each world in which to slow down, `(...)` bool.
    """
    slides = physics.bind(self._slides)
    wanted = self._in_frame(physics, velocity)
    is_faster = (slides.qvel**2).sum(axis=-1) > (wanted**2).sum(axis=-1)
    is_slowed = np.asarray(where & is_faster)[..., np.newaxis]
    slides.qvel = np.where(is_slowed, wanted, slides.qvel)

  def _in_frame(
      self, physics: protocols.Physics, velocity: np.ndarray
  ) -> np.ndarray:
    """Returns velocities of the slides, which are parallel to the register."""
    velocity = self._surroundings.in_frame(physics, velocity)
    return velocity[..., : len(self._slides)]


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
    return rotations.heading_of(physics.bind(self._rotation).qpos)

  def _orientation(self, physics: protocols.Physics) -> np.ndarray:
    return np.asarray(physics.bind(self._rotation).qpos)

  def turn(self, physics: protocols.Physics, heading: np.ndarray) -> None:
    quaternion = self._orientation(physics)
    turned = rotations.turned(
        rotations.quaternion_of(heading - rotations.heading_of(quaternion)),
        quaternion,
    )
    physics.bind(self._rotation).qpos = turned

  def put(
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    self._let_go(physics)
    physics.bind(self._slides).qpos = np.subtract(position, self._rest)
    physics.bind(self._rotation).qpos = rotations.quaternion_of(heading)
    physics.bind(self._joints).qvel = 0.0


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

  def _orientation(self, physics: protocols.Physics) -> np.ndarray:
    return rotations.quaternion_of(self.heading(physics))

  def turn(self, physics: protocols.Physics, heading: np.ndarray) -> None:
    physics.bind(self._hinge).qpos = np.asarray(heading)[..., np.newaxis]

  def put(
      self, physics: protocols.Physics, position: Any, heading: Any = None
  ) -> None:
    self._let_go(physics)
    position = np.asarray(position)
    physics.bind(self._slides).qpos = position[..., :2] - self._rest[:2]
    physics.bind(self._hinge).qpos = (
        0.0 if heading is None else np.asarray(heading)[..., np.newaxis]
    )
    physics.bind(self._joints).qvel = 0.0


def contact(half_size: float) -> dict[str, Any]:
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

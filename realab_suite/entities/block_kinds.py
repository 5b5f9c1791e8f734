"""Blocks: cubes whose poses store the values of registers.

The position and heading of a block are given in the frame of its register,
whose x axis carries the value. A free block can be moved in six degrees of
freedom, and a planar block only along the floor.
"""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple, final

from dm_control import mjcf
import numpy as np

from realab_suite.entities import axes
from realab_suite.entities import block_contacts
from realab_suite.entities import grasps
from realab_suite.entities import protocols
from realab_suite.entities import rotations
from realab_suite.entities import state
from realab_suite.entities import surroundings

# Smallest edge length of a block in a design, in m. A thrown block lands at up
# to 2.8 m/s, which is 28 mm in a substep of 10 ms. The centre of a block with
# less than twice that edge length would be below the floor after the substep.
LEAST_SIZE = 0.06
# Longest substeps of the physics for blocks of usual sizes and masses, and for
# all others, in s. With long ones, blocks of 6 cm or of 10 g were pushed into
# the floor, and cubes of more than 0.5 m left other ones at up to 3.3 m/s.
LONG_SUBSTEP, SHORT_SUBSTEP = 0.025, 0.01
# Usual edge lengths, in m, and the smallest usual mass, in kg.
_USUAL_SIZES = (0.15, 0.4)
_USUAL_MASS = 0.1
_INTO_FLOOR = 'push such blocks into the floor'
# Height at which an avatar carries a block, in m.
GRIP_HEIGHT = 0.2
# Gap between a planar block and the floor, in m, so that they never touch.
_HOVER = 0.004
# Friction loss of the joints of a planar block, in N, in place of contact with
# the floor.
_PLANAR_FRICTION = 6.0


@final
class Misfit(NamedTuple):
  """Reason for which a block needs shorter substeps, as parts of a message.

  Attributes:
    given: Size or mass of the block.
    effect: Effect of the substeps on such blocks.
    allowed: Sizes or masses that are allowed with these substeps.
  """

  given: str
  effect: str
  allowed: str


def find_misfit(block: 'Block', timestep: float) -> Misfit | None:
  """Returns why substeps are too long for a block; `None` if they are not.

  Args:
    block: The block.
    timestep: Duration of a substep of the physics, in s.
  """
  if timestep <= SHORT_SUBSTEP:
    return None
  size, mass = 2 * block.half_size, block.geom.mass
  least, most = _USUAL_SIZES
  if not least <= size <= most:
    return Misfit(
        f'block_size {size:g} m',
        _INTO_FLOOR if size < least else 'let such blocks eject others',
        f'{least:g} to {most:g} m',
    )
  if mass < _USUAL_MASS:
    return Misfit(
        f'mass {mass:g} kg', _INTO_FLOOR, f'{_USUAL_MASS:g} kg and more'
    )
  return None


class Block(abc.ABC):
  """Base class for the blocks of registers, whose joints belong to its model.

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
      direction: tuple[float, float] | None = None,
      ports: Sequence[str] = (),
      turns_along: bool = False,
  ) -> None:
    """Adds the block to the model of a register.

    Args:
      mjcf_model: Model of the register.
      name: Name of the body; the names of its joints begin with it.
      position: Position at rest, `(x, y)`, in m.
      half_size: Half the edge length, in m.
      mass: Mass, in kg.
      style: Geom attributes; see `appearance.geom_style`.
      direction: As the property of that name.
      ports: As the property of that name.
      turns_along: As the property of that name.
    """
    self._half_size = half_size
    self._direction = direction
    self._ports = tuple(ports)
    self._turns_along = turns_along
    self._physics: protocols.Physics | None = None
    self._moved: Any = None
    self._grasps: list[grasps.Grasp] = []
    self._rest = np.array([*position, self.rest_height])
    self._body = mjcf_model.worldbody.add('body', name=name, pos=self._rest)
    self._geom = self._body.add(
        'geom',
        name=name,
        type='box',
        size=[half_size] * 3,
        mass=mass,
        **block_contacts.attributes(half_size),
        **style,
    )
    self._site = self._body.add(
        'site',
        name=f'{name}_grip',
        size=[0.01],
        group=4,
        pos=[0.0, 0.0, self._grip_offset],
    )
    self._surroundings = surroundings.Surroundings(
        self._body, self._rest, half_size
    )
    self._written_slot = state.Slot(mjcf_model, f'{name}_written')

  @property
  def grasps(self) -> list[grasps.Grasp]:
    """Grasps by which hands can hold the block."""
    return self._grasps

  @property
  def half_size(self) -> float:
    """Half the edge length, in m."""
    return self._half_size

  @property
  def direction(self) -> tuple[float, float] | None:
    """Direction of the motion that raises the reading of the register.

    It is `(x, y)` of length 1 in the register's frame, or `None` for a block
    with no such direction, for example one that has to be turned. Audits and
    saboteurs move the block in this direction and against it, or else in four
    directions.
    """
    return self._direction

  @property
  def ports(self) -> tuple[str, ...]:
    """Ports of the register that depend on the block; none stands for all."""
    return self._ports

  @property
  def turns_along(self) -> bool:
    """True if the block turns with a hand that holds it."""
    return self._turns_along

  @property
  def body(self) -> mjcf.Element:
    """Body of the cube."""
    return self._body

  @property
  def geom(self) -> mjcf.Element:
    """Geom of the cube."""
    return self._geom

  @property
  def site(self) -> mjcf.Element:
    """Site that a hand grasps."""
    return self._site

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

  @property
  @abc.abstractmethod
  def rest_height(self) -> float:
    """Height of the centre of a block that rests on the floor, in m."""

  @property
  @abc.abstractmethod
  def _grip_offset(self) -> float:
    """Height of the grip above the centre of the block, in m."""

  def _bind(self, physics: protocols.Physics) -> None:
    """Binds the slides to another physics."""
    self._moved = physics.bind(self._slides)
    self._physics = physics

  @abc.abstractmethod
  def position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the centre in the register's frame, `(..., 3)`, in m."""

  def along(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the x coordinate in the register's frame, `(...)`, in m."""
    if physics is not self._physics:
      self._bind(physics)
    return self._rest[0] + self._moved.qpos.T[0]

  @abc.abstractmethod
  def heading(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle about the vertical, `(...)`, in (-pi, pi]."""

  def orientation(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the orientation as a quaternion, `(..., 4)`."""
    return rotations.quaternion_of(self.heading(physics))

  def slide(
      self,
      physics: protocols.Physics,
      along: np.ndarray,
      where: axes.Mask = None,
  ) -> np.ndarray:
    """Sets the x coordinate in the register's frame, and nothing else.

    The block keeps its other coordinates, its orientation and its velocity, and
    a hand that holds it keeps hold. If the block would be inside an immovable
    object, it gets the nearest free coordinate.

    Args:
      physics: One world or a batch of worlds.
      along: Coordinate, `(...)`, in m.
      where: As in `put`.

    Returns:
      Coordinate that the block got, `(...)`, in m; `along` itself if nothing
      was in the way.
    """
    position = self.position(physics)
    is_far = self._surroundings.are_far(physics, position)
    if not axes.everywhere(is_far):
      along = self._free(position, along, self.orientation(physics), is_far)
    position[..., 0] = along
    moved = position[..., :1] - self._rest[:1]
    slide = physics.bind(self._slides[0])
    if where is None:
      slide.qpos = moved
    else:
      axes.assign(slide, 'qpos', moved, where)
    for grasp in self._grasps:
      if grasp.is_anywhere_held(physics):
        place = self._surroundings.in_world(physics, position)[..., :2]
        is_held = grasp.adapt(physics, place, where)
        self._written_slot.set(physics, 1.0, is_held)
    return along

  @abc.abstractmethod
  def turn(
      self,
      physics: protocols.Physics,
      heading: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    """Sets the angle about the vertical, and nothing else.

    Args:
      physics: One world or a batch of worlds.
      heading: Angle about the vertical, `(...)`, in rad.
      where: As in `put`.
    """

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

  def _free(
      self,
      position: np.ndarray,
      along: np.ndarray,
      orientation: np.ndarray,
      is_far: Any,
  ) -> np.ndarray:
    """Returns the free x coordinates nearest to wanted ones, `(...)`, in m.

    Args:
      position: Present position in the register's frame, `(..., 3)`, in m.
      along: Wanted x coordinate, `(...)`, in m.
      orientation: Orientation, `(..., 4)`.
      is_far: True where no obstacle is near, `(...)` bool.
    """
    free = np.array(np.broadcast_to(along, position.shape[:-1]))
    for world in np.argwhere(~np.asarray(is_far)):
      index = tuple(world)
      free[index] = self._surroundings.nearest_free(
          index,
          np.array([free[index], *position[index][1:]]),
          rotations.matrices(orientation[index]),
          float(position[index][0]),
      )
    return free[()]

  def _let_go(self, physics: protocols.Physics, where: axes.Mask) -> None:
    """Releases the block from every hand.

    Otherwise a teleport of the block would pull the hand along.

    Args:
      physics: One world or a batch of worlds.
      where: As in `put`.
    """
    for grasp in self._grasps:
      grasp.release(physics, where)
    if self._grasps:
      self._written_slot.set(physics, 0.0, where)

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
class FreeBlock(Block):
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
    if physics is not self._physics:
      self._bind(physics)
    return self._rest + np.asarray(self._moved.qpos)

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    return rotations.heading_of(physics.bind(self._rotation).qpos)

  def orientation(self, physics: protocols.Physics) -> np.ndarray:
    return np.asarray(physics.bind(self._rotation).qpos)

  def turn(
      self,
      physics: protocols.Physics,
      heading: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    quaternion = self.orientation(physics)
    turn = rotations.quaternion_of(heading - rotations.heading_of(quaternion))
    turned = rotations.turned(turn, quaternion)
    axes.assign(physics.bind(self._rotation), 'qpos', turned, where)

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    self._let_go(physics, where)
    moved = np.subtract(position, self._rest)
    turned = rotations.quaternion_of(heading)
    axes.assign(physics.bind(self._slides), 'qpos', moved, where)
    axes.assign(physics.bind(self._rotation), 'qpos', turned, where)
    axes.assign(physics.bind(self._joints), 'qvel', 0.0, where)


@final
class PlanarBlock(Block):
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
        'joint',
        name=f'{name}_hinge',
        type='hinge',
        axis=(0, 0, 1),
        frictionloss=_PLANAR_FRICTION * self._half_size / 2,
    )
    self._joints = (*self._slides, self._hinge)

  @property
  def rest_height(self) -> float:
    return self._half_size + _HOVER

  @property
  def _grip_offset(self) -> float:
    # A grip at another height would pull in a direction without a joint.
    return GRIP_HEIGHT - self.rest_height

  def stand_at(self, height: float) -> None:
    """Adapts the grip, which is at the height of the hand, to a surface.

    Args:
      height: Height of the surface that the register stands on, in m.
    """
    self._site.pos = [0.0, 0.0, self._grip_offset - height]

  def position(self, physics: protocols.Physics) -> np.ndarray:
    if physics is not self._physics:
      self._bind(physics)
    moved = self._moved.qpos
    position = np.empty((*moved.shape[:-1], 3))
    position[..., :2] = self._rest[:2] + moved
    position[..., 2] = self._rest[2]
    return position

  def heading(self, physics: protocols.Physics) -> np.ndarray:
    angle = physics.bind(self._hinge).qpos.T[0]
    return np.arctan2(np.sin(angle), np.cos(angle))

  def turn(
      self,
      physics: protocols.Physics,
      heading: np.ndarray,
      where: axes.Mask = None,
  ) -> None:
    angle = np.asarray(heading)[..., np.newaxis]
    axes.assign(physics.bind(self._hinge), 'qpos', angle, where)

  def put(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any = None,
      where: axes.Mask = None,
  ) -> None:
    self._let_go(physics, where)
    moved = np.asarray(position)[..., :2] - self._rest[:2]
    angle = 0.0 if heading is None else np.asarray(heading)[..., np.newaxis]
    axes.assign(physics.bind(self._slides), 'qpos', moved, where)
    axes.assign(physics.bind(self._hinge), 'qpos', angle, where)
    axes.assign(physics.bind(self._joints), 'qvel', 0.0, where)

"""The avatar: the body that an agent acts and senses with."""

from collections.abc import Collection, Sequence
from typing import Any, final

from dm_control import mjcf
from dm_env import specs
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_contacts
from realab_suite.entities import block_kinds
from realab_suite.entities import cameras
from realab_suite.entities import grasps
from realab_suite.entities import measurables
from realab_suite.entities import protocols
from realab_suite.entities import rays

# Indices of each sense in the result of `Avatar.proprioception`.
PROPRIOCEPTION = {
    'velocity': slice(0, 3),
    'position': slice(3, 5),
    'heading': slice(5, 7),
    'pitch': slice(7, 8),
    'holding': slice(8, 9),
}
# Names of the elements of an action; see `Avatar.apply_action`.
ACTIONS = ('forward', 'strafe', 'turn', 'look', 'grasp', 'throw')
RAY_HEIGHT = 0.15
"""Height of the rays above the floor, in m."""

_COLOUR = (0.92, 0.92, 0.95, 1.0)
_RADIUS = 0.25
_HALF_HEIGHT = 0.35
_CLEARANCE = 0.05
_MASS = 40.0
# Walking speed in m/s and turning rate in rad/s, at full command.
_SPEED, _TURN_RATE = 2.0, 3.0
_EYE_HEIGHT = 0.75
_LARGEST_PITCH = 60.0
# Time constant of the velocity servos, in s.
_RESPONSE = 0.05
_FORCE = 600.0
HAND_DISTANCE = 0.45
"""Distance from the middle of the avatar to its hand, in m."""

# Largest distance from the hand to the centre of a block to grasp, in m.
_REACH = 0.4
# Distance at which the hand loses a held block, in m, unless a write has moved
# the block. A block that is stuck behind the end of a wall stays there when the
# avatar continues to walk.
_SLIPS = 0.6
_THROW_SPEED = 5.0
_THROW_LIFT = 2.0
# Contacts of the body are softer than other contacts and take precedence, so
# that a block that is written into the avatar is pushed out slowly. They have
# no friction; otherwise a block that was written under the body would be
# dragged along.
_CONTACT: dict[str, Any] = {
    'priority': 1,
    'solref': (0.08, 1.0),
    'friction': (0.0, 0.01, 0.001),
}


@final
class Avatar(measurables.MeasurableEntity):
  """A cylinder that walks, strafes, turns, looks, pushes, carries and throws.

  The avatar moves in the plane of the floor. Attach it at the origin of an
  arena; its joints hold its position. As with the walkers of
  `dm_control.locomotion`, a task calls `apply_action` from its `before_step`.
  """

  def _build(
      self,
      name: str = 'avatar',
      num_rays: int = 32,
      field_of_view: float = 160.0,
  ) -> None:
    """Builds the avatar.

    Args:
      name: Name of the model.
      num_rays: Number of rays of the ray sense.
      field_of_view: Field of view of the ray sense, in degrees.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    self._mjcf_root.compiler.angle = 'radian'
    self._body = self._mjcf_root.worldbody.add('body', name='torso')
    self._slides = tuple(
        self._body.add('joint', name=axis, type='slide', axis=vector)
        for axis, vector in zip('xy', np.eye(3)[:2], strict=True)
    )
    self._yaw = self._body.add(
        'joint', name='yaw', type='hinge', axis=(0, 0, 1)
    )
    self._torso = self._body.add(
        'geom',
        name='torso',
        type='cylinder',
        mass=_MASS,
        size=(_RADIUS, _HALF_HEIGHT),
        pos=(0, 0, _CLEARANCE + _HALF_HEIGHT),
        rgba=_COLOUR,
        **_CONTACT,
    )
    self._head = self._body.add('body', name='head', pos=(0, 0, _EYE_HEIGHT))
    self._pitch = self._head.add(
        'joint',
        name='pitch',
        type='hinge',
        axis=(0, -1, 0),
        armature=0.02,
        limited='true',
        range=np.radians([-_LARGEST_PITCH, _LARGEST_PITCH]),
    )
    self._head.add(
        'geom',
        name='head',
        type='sphere',
        size=(0.12,),
        mass=0.5,
        contype=0,
        conaffinity=0,
        rgba=_COLOUR,
    )
    # A nose, so that a video shows the direction in which the avatar faces.
    self._head.add(
        'geom',
        name='nose',
        type='capsule',
        size=(0.04,),
        mass=0.0,
        fromto=(0.08, 0, 0, 0.22, 0, 0),
        contype=0,
        conaffinity=0,
        rgba=(0.9, 0.3, 0.2, 1.0),
    )
    self._joints = (*self._slides, self._yaw, self._pitch)
    self._camera = self._head.add(
        'camera',
        name='egocentric',
        fovy=80,
        pos=(0.1, 0, 0),
        xyaxes=(0, -1, 0, 0, 0, 1),
    )
    self._hand = self._body.add(
        'site',
        name='hand',
        size=[0.02],
        group=4,
        pos=(HAND_DISTANCE, 0, block_kinds.GRIP_HEIGHT),
    )
    self._add_actuators()
    self._rays = rays.RaySense(num_rays=num_rays, field_of_view=field_of_view)
    self.attach(
        self._rays,
        self._body.add('site', name='rays', pos=(0, 0, RAY_HEIGHT), group=4),
    )
    self._physics: protocols.Physics | None = None
    self._grasps: dict[block_kinds.Block, grasps.Grasp] = {}
    self._pairs: list[mjcf.Element] = []

  def _add_actuators(self) -> None:
    """Adds velocity servos; the walking servos act in the avatar's frame."""
    feet = self._body.add('site', name='feet', group=4)
    total = _MASS + 0.5
    inertia = 0.5 * _MASS * _RADIUS**2
    servos = (
        ('forward', {'site': feet, 'gear': (1, 0, 0, 0, 0, 0)}, total, _SPEED),
        ('strafe', {'site': feet, 'gear': (0, 1, 0, 0, 0, 0)}, total, _SPEED),
        ('turn', {'joint': self._yaw}, inertia, _TURN_RATE),
        ('look', {'joint': self._pitch}, 0.024, _TURN_RATE / 2),
    )
    # force = gain * (fastest * ctrl - velocity) with ctrl in [-1, 1].
    self._actuators = tuple(
        self._mjcf_root.actuator.add(
            'general',
            name=name,
            ctrllimited='true',
            ctrlrange=(-1, 1),
            forcelimited='true',
            forcerange=(-_FORCE, _FORCE),
            biastype='affine',
            gainprm=[fastest * mass / _RESPONSE],
            biasprm=[0, 0, -mass / _RESPONSE],
            **transmission,
        )
        for name, transmission, mass, fastest in servos
    )

  @property
  def body(self) -> mjcf.Element:
    return self._body

  @property
  def torso(self) -> mjcf.Element:
    """Geom of the body."""
    return self._torso

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable((self._body,))

  @property
  def camera(self) -> mjcf.Element:
    """Egocentric camera, at eye height."""
    return self._camera

  @property
  def rays(self) -> rays.RaySense:
    """Ray sense of the avatar."""
    return self._rays

  @property
  def radius(self) -> float:
    """Radius of the body, in m."""
    return _RADIUS

  @property
  def action_spec(self) -> specs.BoundedArray:
    """Spec of an action: shape `(6,)`, float64, in [-1, 1].

    The name of the spec is `ACTIONS`, joined by tabs.
    """
    return specs.BoundedArray(
        (len(ACTIONS),), np.float64, -1.0, 1.0, name='\t'.join(ACTIONS)
    )

  def sense_spec(
      self, codes: Sequence[int], camera_size: tuple[int, int]
  ) -> dict[str, specs.Array]:
    """Returns the specs of the senses, by name, for one world.

    Args:
      codes: Codes of the classes of objects that the world can contain.
      camera_size: Height and width of the egocentric image, in pixels.
    """
    shape = (len(self._rays.angles),)
    return {
        'ray_distances': specs.BoundedArray(
            shape, np.float32, 0.0, self._rays.max_distance
        ),
        'ray_classes': appearance.ClassArray(shape, codes),
        'velocity': specs.Array((3,), np.float32),
        'position': specs.Array((2,), np.float32),
        'heading': specs.BoundedArray((2,), np.float32, -1.0, 1.0),
        'pitch': specs.Array((1,), np.float32),
        'holding': specs.BoundedArray((1,), np.float32, 0.0, 1.0),
        'camera': specs.BoundedArray((*camera_size, 3), np.uint8, 0, 255),
    }

  def senses(
      self,
      physics: protocols.Physics,
      names: Collection[str],
      camera_size: tuple[int, int],
  ) -> dict[str, np.ndarray]:
    """Returns the selected senses, by name. No other senses are computed.

    Args:
      physics: One world or a batch of worlds.
      names: Names of the selected senses; others are ignored.
      camera_size: Height and width of the egocentric image, in pixels.

    Returns:
      New arrays that match `sense_spec`, with leading axes `(...)`.
    """
    senses: dict[str, np.ndarray] = {}
    if 'ray_distances' in names or 'ray_classes' in names:
      distances, classes = self._rays.sense(physics)
      if 'ray_distances' in names:
        senses['ray_distances'] = distances
      if 'ray_classes' in names:
        senses['ray_classes'] = classes
    parts = [name for name in PROPRIOCEPTION if name in names]
    if parts:
      body = self.proprioception(physics).astype(np.float32)
      for name in parts:
        senses[name] = body[..., PROPRIOCEPTION[name]]
    if 'camera' in names:
      senses['camera'] = cameras.render(physics, self._camera, *camera_size)
    return senses

  def make_graspable(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Makes blocks graspable by the hand.

    Contacts of the body with large blocks become softer.

    Call this after all entities are attached and before the physics is
    compiled.

    Args:
      blocks: Blocks of registers.
    """
    for block in blocks:
      self._soften_contact(block)
      self._grasps[block] = grasps.Grasp(
          self._hand, block.site, self._hand_position, block.turns_along
      )
      block.grasps.append(self._grasps[block])
    self._physics = None

  def _soften_contact(self, block: block_kinds.Block) -> None:
    """Makes contacts of the body with a block softer, if the block is large."""
    if (softness := block_contacts.softness(block.half_size)) <= 1.0:
      return
    time, damping = _CONTACT['solref']
    slip, spin, roll = _CONTACT['friction']
    pair = self._mjcf_root.root_model.contact.add(
        'pair',
        geom1=self._torso,
        geom2=block.geom,
        condim=3,
        solref=(time * softness, damping),
        friction=(slip, slip, spin, roll, roll),
    )
    self._pairs.append(pair)

  @property
  def graspable(self) -> Sequence[block_kinds.Block]:
    """Blocks that the hand can grasp, in the order in which they were added."""
    return tuple(self._grasps)

  def forget(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Undoes `make_graspable` for the given blocks."""
    geoms = [block.geom for block in blocks]
    for pair in [p for p in self._pairs if p.geom2 in geoms]:
      self._pairs.remove(pair)
      pair.remove()
    for block in [b for b in self._grasps if b in blocks]:
      grasp = self._grasps.pop(block)
      block.grasps.remove(grasp)
      grasp.remove()
    self._physics = None

  def place(
      self,
      physics: protocols.Physics,
      position: Any,
      heading: Any,
      where: axes.Mask = None,
  ) -> None:
    """Moves the avatar to a pose, at rest.

    Args:
      physics: One world or a batch of worlds.
      position: `(..., 2)`, in m.
      heading: Angle to the x axis, `(...)`, in rad.
      where: Worlds in which to move it, `(...)` bool; `None` for all worlds.
    """
    slides, yaw = physics.bind(self._slides), physics.bind(self._yaw)
    axes.assign(slides, 'qpos', position, where)
    axes.assign(slides, 'qvel', 0.0, where)
    axes.assign(yaw, 'qpos', np.asarray(heading)[..., np.newaxis], where)
    axes.assign(yaw, 'qvel', 0.0, where)

  def let_go(self, physics: protocols.Physics, where: axes.Mask) -> None:
    """Empties the hand.

    Args:
      physics: One world or a batch of worlds.
      where: Worlds in which to do so, `(...)` bool; `None` for all worlds.
    """
    for grasp in self._grasps.values():
      grasp.release(physics, where)

  def apply_action(
      self, physics: protocols.Physics, action: np.ndarray
  ) -> None:
    """Sets the motors and the hand for one control step.

    Args:
      physics: One world or a batch of worlds.
      action: `(..., 6)` in [-1, 1]. Forward, strafe (to the left), turn (to the
        left) and look (up) are fractions of the greatest velocity. A grasp of
        at least 0.5 grasps the nearest block in reach, and a grasp of at most
        -0.5 releases the held block. A throw of at least 0.5 throws the held
        block. Otherwise the hand keeps a block unless the block gets stuck.
    """
    if physics is not self._physics:
      self._bind(physics)
    self._motors.ctrl = action[..., : len(self._actuators)]
    if self._grasps:
      *_, grasp, throw = action.T
      self._use_hand(physics, grasp, throw)

  def position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the position of the avatar, `(..., 2)`, in m."""
    if physics is not self._physics:
      self._bind(physics)
    return np.array(self._moved.qpos)

  def angle(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle of the avatar to the x axis, `(...)`, in rad."""
    return np.array(physics.bind(self._yaw).qpos[..., 0])[()]

  def direction(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the unit vector in which the avatar faces, `(..., 2)`."""
    return self.proprioception(physics)[..., PROPRIOCEPTION['heading']]

  def velocity(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the velocity in the avatar's frame, `(..., 3)`.

    The components are forward and to the left, in m/s, and turning to the left,
    in rad/s.
    """
    return self.proprioception(physics)[..., PROPRIOCEPTION['velocity']]

  def holding(self, physics: protocols.Physics) -> np.ndarray:
    """Returns 1 if the hand holds a block, otherwise 0, `(..., 1)`."""
    return self.proprioception(physics)[..., PROPRIOCEPTION['holding']]

  def proprioception(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the senses of the body, `(..., 9)`.

    `PROPRIOCEPTION` has the indices of each. The pitch is the upward angle of
    the head, in rad.
    """
    if physics is not self._physics:
      self._bind(physics)
    joints = self._posture
    x, y, angle, pitch = joints.qpos.T
    speed_x, speed_y, turning, _ = joints.qvel.T
    cos, sin = np.cos(angle), np.sin(angle)
    body = np.empty((*angle.shape, 9))
    body[..., 0] = cos * speed_x + sin * speed_y
    body[..., 1] = cos * speed_y - sin * speed_x
    body[..., 2] = turning
    body[..., 3] = x
    body[..., 4] = y
    body[..., 5] = cos
    body[..., 6] = sin
    body[..., 7] = pitch
    body[..., 8] = 0.0
    if self._grasps:
      active = self._holds.active
      body[..., 8] = np.logical_or.reduce(active, axis=-1)
    return body

  def _bind(self, physics: protocols.Physics) -> None:
    """Binds what each control step needs to another physics."""
    self._motors = physics.bind(self._actuators)
    self._moved = physics.bind(self._slides)
    self._posture = physics.bind(self._joints)
    self._holds = physics.bind(grasps.constraints_of(self._grasps.values()))
    self._physics = physics

  def _use_hand(
      self, physics: protocols.Physics, grasp: np.ndarray, throw: np.ndarray
  ) -> None:
    """Grasps, releases and throws blocks; `grasp` and `throw` are `(...)`."""
    constraints = self._holds
    active = np.asarray(constraints.active)
    is_empty = not np.count_nonzero(active)
    if is_empty and not axes.anywhere(grasp >= 0.5):
      return  # The most frequent case: no block to throw or to release.
    held = grasps.held(active)
    hand = physics.bind(self._hand).xpos
    sites = [block.site for block in self._grasps]
    offsets = physics.bind(sites).xpos - hand[..., np.newaxis, :]
    squares = offsets * offsets
    # The hand grasps a block in front of it at any height.
    distances = np.sqrt(squares[..., 0] + squares[..., 1])
    is_in_reach = distances <= _REACH
    if is_empty and not np.count_nonzero(is_in_reach):
      return  # No block to grasp.
    nearest = (
        np.arange(len(sites)) == distances.argmin(axis=-1)[..., np.newaxis]
    )
    takes = (
        (np.asarray(grasp) >= 0.5)[..., np.newaxis]
        & ~held.any(axis=-1, keepdims=True)
        & nearest
        & is_in_reach
    )
    throws = (np.asarray(throw) >= 0.5)[..., np.newaxis]
    drops = (np.asarray(grasp) <= -0.5)[..., np.newaxis] | throws
    released = held & drops & ~throws
    for i, block in enumerate(self._grasps):
      is_written = block.written_slot.get(physics) > 0
      held[..., i] &= (distances[..., i] <= _SLIPS) | is_written
      block.written_slot.set(physics, 0.0)
    if (thrown := held & throws).any():
      direction = self.direction(physics)
      lift = np.full((*direction.shape[:-1], 1), _THROW_LIFT)
      velocity = np.concatenate([_THROW_SPEED * direction, lift], axis=-1)
      for i, block in enumerate(self._grasps):
        block.launch(physics, velocity, thrown[..., i])
    # In a batch, hands can throw in some worlds and release in others.
    if released.any():
      velocity = self._hand_velocity(physics)
      for i, block in enumerate(self._grasps):
        block.slow_down(physics, velocity, released[..., i])
    is_held = (held | takes) & ~drops
    constraints.active = grasps.active(is_held, distances)
    for i, grasp_of_block in enumerate(self._grasps.values()):
      grasp_of_block.turn_along(physics, is_held[..., i])

  def _hand_position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the position of the hand, `(..., 2)`, from the state alone."""
    angle = physics.bind(self._yaw).qpos.T[0]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return physics.bind(self._slides).qpos + HAND_DISTANCE * direction

  def _hand_velocity(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the velocity of the hand in the world frame, `(..., 3)`."""
    angle = physics.bind(self._yaw).qpos.T[0]
    turning = HAND_DISTANCE * physics.bind(self._yaw).qvel.T[0]
    walking = physics.bind(self._slides).qvel
    velocity = np.zeros((*walking.shape[:-1], 3))
    velocity[..., 0] = walking[..., 0] - turning * np.sin(angle)
    velocity[..., 1] = walking[..., 1] + turning * np.cos(angle)
    return velocity

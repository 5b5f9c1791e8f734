"""The body that an agent acts and senses with."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.entities import rays

# Where each sense is in what `Avatar.proprioception` returns.
PROPRIOCEPTION = {
    'velocity': slice(0, 3),
    'position': slice(3, 5),
    'heading': slice(5, 7),
    'pitch': slice(7, 8),
    'holding': slice(8, 9),
}
# Element by element, what an action is made of; see `Avatar.apply_action`.
ACTIONS = ('forward', 'strafe', 'turn', 'look', 'grasp', 'throw')

_RADIUS = 0.25
_HALF_HEIGHT = 0.35
_CLEARANCE = 0.05
_MASS = 40.0
_EYE_HEIGHT = 0.75
_RAY_HEIGHT = 0.15
_LARGEST_PITCH = 60.0
# How soon a commanded velocity is reached, seconds.
_RESPONSE = 0.05
_FORCE = 600.0
_HAND_DISTANCE = 0.45
# How far the hand reaches, from its own place to the middle of a block, metres.
_REACH = 0.4
# How far off what it holds may be before it loses it: a block that is stuck
# behind the end of a wall stays there when the avatar walks on.
_SLIPS = 0.6
_THROW_SPEED = 5.0
_THROW_LIFT = 2.0
# Contacts of the body are softer than those of other things and take
# precedence: what is written into the avatar is pushed out slowly. They do not
# grip, or a block that was written under the body would be dragged along.
_CONTACT: dict[str, Any] = {
    'priority': 1,
    'solref': (0.08, 1.0),
    'friction': (0.0, 0.01, 0.001),
}
# A block that is taken hold of comes to the hand in about 0.05 s. The hand is
# weaker than walls: at MuJoCo's own 0.95 it pulled a block of 1 kg through one.
_GRASP = {'solref': (0.05, 1.0), 'solimp': (0.7, 0.7, 0.001)}


@final
class AvatarObservables(composer.Observables):
  """What the avatar knows of itself, and what it sees."""

  @composer.observable
  def velocity(self) -> observable.Generic:
    return observable.Generic(self._entity.velocity)

  @composer.observable
  def position(self) -> observable.Generic:
    return observable.Generic(self._entity.position)

  @composer.observable
  def heading(self) -> observable.Generic:
    return observable.Generic(self._entity.direction)

  @composer.observable
  def pitch(self) -> observable.Generic:
    return observable.Generic(self._entity.pitch)

  @composer.observable
  def holding(self) -> observable.Generic:
    return observable.Generic(self._entity.holding)

  @composer.observable
  def egocentric_camera(self) -> observable.MJCFCamera:
    return observable.MJCFCamera(self._entity.camera, height=64, width=64)

  @property
  def proprioception(self) -> list[observable.Observable]:
    """The observables of the body itself."""
    return [
        self.velocity, self.position, self.heading, self.pitch, self.holding
    ]  # fmt: skip


@final
class Avatar(composer.Entity):
  """A cylinder that walks, strafes, turns, looks, pushes, carries and throws.

  It moves in the plane of the floor. Attach it at the origin of an arena; where
  it is, is in its joints. Like the walkers of `dm_control.locomotion`, it is
  moved by `apply_action`, which a task calls from its `before_step`.
  """

  def _build(
      self,
      name: str = 'avatar',
      speed: float = 2.0,
      turn_rate: float = 3.0,
      num_rays: int = 32,
      field_of_view: float = 160.0,
  ) -> None:
    """Builds the avatar.

    Args:
      name: The name of the model.
      speed: The speed of walking at full command, metres per second.
      turn_rate: The rate of turning at full command, radians per second.
      num_rays: How many rays its ray sense has.
      field_of_view: Of the ray sense, degrees.
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
        'geom', name='torso', type='cylinder', mass=_MASS,
        size=(_RADIUS, _HALF_HEIGHT), pos=(0, 0, _CLEARANCE + _HALF_HEIGHT),
        rgba=appearance.COLOURS['avatar'], **_CONTACT
    )  # fmt: skip
    self._head = self._body.add('body', name='head', pos=(0, 0, _EYE_HEIGHT))
    self._pitch = self._head.add(
        'joint', name='pitch', type='hinge', axis=(0, -1, 0), armature=0.02,
        limited='true', range=np.radians([-_LARGEST_PITCH, _LARGEST_PITCH]),
    )  # fmt: skip
    self._head.add(
        'geom', name='head', type='sphere', size=(0.12,), mass=0.5,
        contype=0, conaffinity=0, rgba=appearance.COLOURS['avatar'],
    )  # fmt: skip
    # A nose, so that a film shows which way the avatar faces.
    self._head.add(
        'geom', name='nose', type='capsule', size=(0.04,), mass=0.0,
        fromto=(0.08, 0, 0, 0.22, 0, 0), contype=0, conaffinity=0,
        rgba=(0.9, 0.3, 0.2, 1.0),
    )  # fmt: skip
    self._camera = self._head.add(
        'camera', name='egocentric', fovy=80, pos=(0.1, 0, 0),
        xyaxes=(0, -1, 0, 0, 0, 1),
    )  # fmt: skip
    self._hand = self._body.add(
        'site', name='hand', size=[0.02], group=4,
        pos=(_HAND_DISTANCE, 0, block_kinds.GRIP_HEIGHT),
    )  # fmt: skip
    self._add_actuators(speed, turn_rate)
    self._rays = rays.RaySense(num_rays=num_rays, field_of_view=field_of_view)
    self.attach(
        self._rays,
        self._body.add('site', name='rays', pos=(0, 0, _RAY_HEIGHT), group=4),
    )
    self._blocks: list[block_kinds.JointedBlock] = []
    self._grasps: list[mjcf.Element] = []
    self._pairs: list[mjcf.Element] = []

  def _add_actuators(self, speed: float, turn_rate: float) -> None:
    """Adds velocity servos; those of walking act in the avatar's own frame."""
    feet = self._body.add('site', name='feet', group=4)
    total = _MASS + 0.5
    inertia = 0.5 * _MASS * _RADIUS**2
    servos = (
        ('forward', {'site': feet, 'gear': (1, 0, 0, 0, 0, 0)}, total, speed),
        ('strafe', {'site': feet, 'gear': (0, 1, 0, 0, 0, 0)}, total, speed),
        ('turn', {'joint': self._yaw}, inertia, turn_rate),
        ('look', {'joint': self._pitch}, 0.024, turn_rate / 2),
    )
    # force = gain * (fastest * ctrl - velocity), so that ctrl is in [-1, 1].
    self._actuators = tuple(
        self._mjcf_root.actuator.add(
            'general', name=name, ctrllimited='true', ctrlrange=(-1, 1),
            forcelimited='true', forcerange=(-_FORCE, _FORCE),
            biastype='affine', gainprm=[fastest * mass / _RESPONSE],
            biasprm=[0, 0, -mass / _RESPONSE], **transmission
        )
        for name, transmission, mass, fastest in servos
    )  # fmt: skip

  def _build_observables(self) -> AvatarObservables:
    return AvatarObservables(self)

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def body(self) -> mjcf.Element:
    return self._body

  @property
  def camera(self) -> mjcf.Element:
    """The egocentric camera, at eye height."""
    return self._camera

  @property
  def rays(self) -> rays.RaySense:
    return self._rays

  @property
  def radius(self) -> float:
    """Of the body, metres."""
    return _RADIUS

  @property
  def action_spec(self) -> specs.BoundedArray:
    """Six elements in [-1, 1], named as in `ACTIONS`, tab-separated."""
    return specs.BoundedArray(
        (len(ACTIONS),), np.float64, -1.0, 1.0, name='\t'.join(ACTIONS)
    )

  def make_graspable(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Lets the hand take hold of blocks; welded ones are passed over.

    Blocks that are larger than usual are also made softer to the body.

    Call it after everything is attached and before the physics is compiled.
    """
    root = self._mjcf_root.root_model
    for block in blocks:
      if (softness := block_kinds.softness(block.half_size)) > 1.0:
        time, damping = _CONTACT['solref']
        slip, spin, roll = _CONTACT['friction']
        pair = root.contact.add(
            'pair', geom1=self._torso, geom2=block.geom, condim=3,
            solref=(time * softness, damping),
            friction=(slip, slip, spin, roll, roll),
        )  # fmt: skip
        self._pairs.append(pair)
      if not isinstance(block, block_kinds.JointedBlock):
        continue
      # Between two sites, a held block can turn; a weld would lock the yaw of
      # an avatar that holds a block which cannot.
      grasp = root.equality.add(
          'connect', site1=self._hand, site2=block.site, active='false',
          **_GRASP
      )  # fmt: skip
      block.grasps.append(grasp)
      self._grasps.append(grasp)
      self._blocks.append(block)

  def forget(self, blocks: Sequence[block_kinds.Block]) -> None:
    """Undoes `make_graspable` for some blocks."""
    geoms = [block.geom for block in blocks]
    for pair in [p for p in self._pairs if p.geom2 in geoms]:
      self._pairs.remove(pair)
      pair.remove()
    for block in [b for b in self._blocks if b in blocks]:
      i = self._blocks.index(block)
      grasp = self._grasps.pop(i)
      self._blocks.pop(i)
      block.grasps.remove(grasp)
      grasp.remove()

  def place(
      self, physics: protocols.Physics, position: Any, heading: Any
  ) -> None:
    """Puts the avatar somewhere, at rest.

    Args:
      physics: One world, or many.
      position: `(..., 2)`, metres.
      heading: The angle to the x axis, shape `(...)`, radians.
    """
    physics.bind(self._slides).qpos = position
    physics.bind(self._slides).qvel = 0.0
    physics.bind(self._yaw).qpos = np.asarray(heading)[..., np.newaxis]
    physics.bind(self._yaw).qvel = 0.0

  def apply_action(
      self, physics: protocols.Physics, action: np.ndarray
  ) -> None:
    """Sets the motors and the hand for one control step.

    Args:
      physics: One world, or many.
      action: `(..., 6)` in [-1, 1]: forward, strafe (to the left), turn (to the
        left) and look (up) are fractions of the greatest velocity; grasp >= 0.5
        takes hold of the nearest block in reach, <= -0.5 lets go; throw >= 0.5
        throws what is held. A hand keeps hold until told otherwise, unless what
        it holds gets stuck.
    """
    physics.bind(self._actuators).ctrl = action[..., : len(self._actuators)]
    if self._grasps:
      grasp, throw = axes.component(action, -2), axes.component(action, -1)
      self._use_hand(physics, grasp, throw)

  def position(self, physics: protocols.Physics) -> np.ndarray:
    """Returns where the avatar is, `(..., 2)`, metres."""
    return np.array(physics.bind(self._slides).qpos)

  def angle(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle that the avatar faces, `(...)`, radians."""
    return np.array(physics.bind(self._yaw).qpos[..., 0])[()]

  def direction(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the unit vector that the avatar faces along, `(..., 2)`."""
    return self.proprioception(physics)[..., PROPRIOCEPTION['heading']]

  def velocity(self, physics: protocols.Physics) -> np.ndarray:
    """Returns velocity forward, leftward (m/s), turning (rad/s), `(..., 3)`."""
    return self.proprioception(physics)[..., PROPRIOCEPTION['velocity']]

  def pitch(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the angle of looking up, `(..., 1)`, radians."""
    return np.array(physics.bind(self._pitch).qpos)

  def holding(self, physics: protocols.Physics) -> np.ndarray:
    """Returns 1 where the hand holds a block and 0 elsewhere, `(..., 1)`."""
    return self.proprioception(physics)[..., PROPRIOCEPTION['holding']]

  def proprioception(self, physics: protocols.Physics) -> np.ndarray:
    """Returns what the avatar knows of itself, `(..., 9)`.

    It is what `velocity`, `position`, `direction`, `pitch` and `holding`
    return, side by side, as `PROPRIOCEPTION` says.
    """
    slides = physics.bind(self._slides)
    x, y = (axes.component(slides.qvel, i) for i in range(2))
    angle = axes.component(physics.bind(self._yaw).qpos, 0)
    cos, sin = np.cos(angle), np.sin(angle)
    body = np.empty((*angle.shape, 9))
    body[..., 0] = cos * x + sin * y
    body[..., 1] = cos * y - sin * x
    body[..., 2:3] = physics.bind(self._yaw).qvel
    body[..., 3:5] = slides.qpos
    body[..., 5] = cos
    body[..., 6] = sin
    body[..., 7:8] = physics.bind(self._pitch).qpos
    body[..., 8] = self._held(physics).any(axis=-1)
    return body

  def _held(self, physics: protocols.Physics) -> np.ndarray:
    """Which block the hand holds, `(..., blocks)`, bool."""
    if not self._grasps:
      return np.zeros((*self.angle(physics).shape, 1), bool)
    return np.asarray(physics.bind(self._grasps).active).astype(bool)

  def _use_hand(
      self, physics: protocols.Physics, grasp: np.ndarray, throw: np.ndarray
  ) -> None:
    held = self._held(physics)
    is_empty = not np.count_nonzero(held)
    if is_empty and not axes.anywhere(grasp >= 0.5):
      return  # Nothing to throw, nothing to let go of: most of the time.
    hand = physics.bind(self._hand).xpos
    sites = [block.site for block in self._blocks]
    offsets = physics.bind(sites).xpos - hand[..., np.newaxis, :]
    squares = offsets * offsets
    # The hand closes on what stands before it, whatever its height.
    distances = np.sqrt(squares[..., 0] + squares[..., 1])
    is_in_reach = distances <= _REACH
    if is_empty and not np.count_nonzero(is_in_reach):
      return  # Nothing to take.
    nearest = (
        np.arange(len(sites)) == distances.argmin(axis=-1)[..., np.newaxis]
    )
    takes = (
        (np.asarray(grasp) >= 0.5)[..., np.newaxis]
        & ~held.any(axis=-1, keepdims=True)
        & nearest
        & is_in_reach
    )
    held &= distances <= _SLIPS
    throws = (np.asarray(throw) >= 0.5)[..., np.newaxis]
    drops = (np.asarray(grasp) <= -0.5)[..., np.newaxis] | throws
    if (thrown := held & throws).any():
      direction = self.direction(physics)
      lift = np.full((*direction.shape[:-1], 1), _THROW_LIFT)
      velocity = np.concatenate([_THROW_SPEED * direction, lift], axis=-1)
      for i, block in enumerate(self._blocks):
        block.launch(physics, velocity, thrown[..., i])
    physics.bind(self._grasps).active = np.where(drops, False, held | takes)

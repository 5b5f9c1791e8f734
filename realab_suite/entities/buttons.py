"""A button whose cap can be held, pulled out, and pressed by a finger."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import block_kinds
from realab_suite.entities import measurables
from realab_suite.entities import protocols

# Half the edge length of the cap, its travel to the north, and the distance by
# which it can be pulled out to the south, in m.
_HALF, _TRAVEL, _OUT = 0.08, 0.12, 0.6
_CAP_MASS, _FINGER_MASS = 1.0, 0.5
# Friction of the cap along its travel, and strength of the finger, in N.
_FRICTION, _STRENGTH = 2.0, 12.0
# The ridge on the cap, along which the finger slides: half its length, half its
# thickness, half its height, and its middle, in m.
_RIDGE, _RIDGE_AT = (0.19, 0.01, 0.04), (0.0, -0.04)
# Radius of the finger's tip, where the tip rests, how far it moves, the length
# of the finger, and its height, in m.
_TIP, _RESTS, _MOVES, _LENGTH, _HEIGHT = 0.03, 0.21, 0.27, 0.8, 0.25
# Speed that the finger would reach without a cap, in m/s, and the gain of its
# servo, in N s/m.
_SPEED, _GAIN = 0.8, 50.0
# Gap between the cap and the walls of its stall, their thickness and height,
# and how far they extend beyond the cap, in m.
_GAP, _WALL, _WALL_HEIGHT, _RECESS = 0.01, 0.45, 0.2, 0.06
# Height of the sill in front of the cap, in m.
_SILL = 0.1
# Range of the joints that keep the cap on its way, in m and rad.
_TIGHT = 0.002
_GREY, _RED = (0.35, 0.36, 0.40, 1.0), (0.85, 0.10, 0.10, 1.0)


@final
class Button(measurables.MeasurableEntity):
  """A cap in a stall that is open to the south, and a finger to the east.

  The finger moves to the west, along a ridge across the cap, which pushes the
  cap to the north, with less force than a hand. A hand that holds the cap keeps
  it in place, presses it by pushing or throwing it, or pulls it out to the
  south, where the finger misses the ridge. A sill keeps avatars' bodies out.
  """

  def _build(self, name: str = 'button') -> None:
    """Builds the button.

    Args:
      name: Name of the model.
    """
    self._mjcf_root = root = mjcf.RootElement(model=name)
    root.compiler.angle = 'radian'
    style = appearance.geom_style(appearance.BUTTON)
    self._cap = block_kinds.PlanarBlock(
        root, 'cap', (0.0, 0.0), _HALF, _CAP_MASS, style
    )
    aside, along, hinge = self._cap.body.find_all('joint')
    along.set_attributes(range=(-_OUT, _TRAVEL), frictionloss=_FRICTION)
    aside.range = hinge.range = (-_TIGHT, _TIGHT)
    for joint in (aside, along, hinge):
      joint.limited = 'true'
    self._slides = (along,)
    ridge = self._cap.body.add(
        'geom',
        name='ridge',
        type='box',
        size=_RIDGE,
        pos=(*_RIDGE_AT, _HALF + _RIDGE[2]),
        euler=(0, 0, np.pi / 4),
        mass=0,
        contype=0,
        conaffinity=0,
        rgba=_RED,
    )
    self._add_finger(ridge)
    self._add_stall()

  def _add_finger(self, ridge: mjcf.Element) -> None:
    """Adds the finger, which touches nothing but the ridge of the cap."""
    finger = self._mjcf_root.worldbody.add('body', name='finger')
    tip = finger.add(
        'geom',
        name='finger',
        type='capsule',
        size=(_TIP,),
        fromto=(_RESTS, 0, _HEIGHT, _RESTS + _LENGTH, 0, _HEIGHT),
        mass=_FINGER_MASS,
        contype=0,
        conaffinity=0,
        rgba=_GREY,
    )
    joint = finger.add(
        'joint',
        name='finger',
        type='slide',
        axis=(1, 0, 0),
        limited='true',
        range=(-_MOVES, 0.0),
    )
    self._mjcf_root.contact.add('pair', geom1=tip, geom2=ridge, condim=1)
    motor = self._mjcf_root.actuator.add(
        'general',
        name='finger',
        joint=joint,
        ctrllimited='true',
        ctrlrange=(-1, 1),
        forcelimited='true',
        forcerange=(-_STRENGTH, _STRENGTH),
        biastype='affine',
        gainprm=[-_SPEED * _GAIN],
        biasprm=[0, 0, -_GAIN],
    )
    self._motors = (motor,)

  def _add_stall(self) -> None:
    """Adds the walls to the west, to the north and to the east of the cap."""
    side = _HALF + _GAP
    south, north = -_HALF - _RECESS, _HALF + _TRAVEL + _GAP
    walls: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
        'west': ((-side - _WALL, -side), (south, north)),
        'east': ((side, side + _WALL), (south, north)),
        'north': ((-side - _WALL, side + _WALL), (north, north + _WALL)),
    }
    for name, spans in walls.items():
      low, high = np.transpose(spans)
      # With all walls in one body, `mj_multiRay` misses some of them.
      wall = self._mjcf_root.worldbody.add('body', name=name)
      wall.add(
          'geom',
          name=name,
          type='box',
          size=(*(high - low) / 2, _WALL_HEIGHT / 2),
          pos=(*(high + low) / 2, _WALL_HEIGHT / 2),
          **appearance.geom_style(appearance.BARRIER, _GREY),
      )

    depth = _RECESS - _GAP
    self._sill = self._mjcf_root.worldbody.add('body', name='sill').add(
        'geom',
        name='sill',
        type='box',
        size=(side, depth / 2, _SILL / 2),
        pos=(0, south + depth / 2, _SILL / 2),
        contype=0,
        conaffinity=0,
        rgba=_GREY,
    )

  def keep_out(self, body: mjcf.Element) -> None:
    """Lets the sill stop a geom; the cap slides across it.

    Args:
      body: Geom of an avatar, in the same world.
    """
    self._mjcf_root.root_model.contact.add(
        'pair', geom1=self._sill, geom2=body, condim=1
    )

  @property
  def cap(self) -> block_kinds.Block:
    """Cap of the button, which a hand can hold."""
    return self._cap

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable((self._cap.body,))

  def attach_to(self, root: composer.Entity, position: Sequence[float]) -> None:
    """Attaches the button to the root entity of a task.

    Args:
      root: Root entity of the task.
      position: Centre of the cap at rest, `(x, y)`, in m.
    """
    root.attach(self).pos = (*position, 0.0)

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Draws the finger back."""
    del random_state
    self.press(physics, False)

  def press(self, physics: protocols.Physics, is_pressing: Any) -> None:
    """Lets the finger press, or draws it back.

    Args:
      physics: One world or a batch of worlds.
      is_pressing: True where it presses, `(...)` bool.
    """
    control = np.where(is_pressing, 1.0, -1.0)[..., np.newaxis]
    physics.bind(self._motors).ctrl = control

  def travelled(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the share of its travel that the cap has gone, `(...)`.

    It is negative if the cap is pulled out.
    """
    return physics.bind(self._slides).qpos.T[0] / _TRAVEL

  def pulled_out(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the distance by which the cap is pulled out, `(...)`, in m."""
    return np.maximum(-physics.bind(self._slides).qpos.T[0], 0.0)

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

# Half the edge length of the cap, its travel, and the distance by which it can
# be pulled out, in m.
_HALF, _TRAVEL, _OUT = 0.12, 0.16, 0.6
_CAP_MASS, _FINGER_MASS = 1.0, 0.5
# Friction of the cap along its travel, and strength of the finger, in N.
_FRICTION, _STRENGTH = 0.5, 4.0
# Gap between the finger and the cap, length and half width of the finger, and
# its height, in m.
_GAP, _LENGTH, _THIN, _HEIGHT = 0.01, 0.9, 0.03, 0.15
# Speed that the finger would reach without a cap, in m/s, and the gain of its
# servo, in N s/m.
_SPEED, _GAIN = 1.0, 50.0
# Half the thickness and the height of the stall's walls, and how far they
# extend beyond the cap, in m. No avatar fits in between.
_WALL, _WALL_HEIGHT, _RECESS = 0.04, 0.3, 0.06
_GREY, _RED = (0.35, 0.36, 0.40, 1.0), (0.85, 0.10, 0.10, 1.0)


@final
class Button(measurables.MeasurableEntity):
  """A cap in a stall that is open to the south, and a finger to the east.

  The finger pushes the cap to the west, with less force than a hand. A hand
  that holds the cap keeps it in place, presses it by moving to the west, or
  pulls it out to the south, where the finger misses it. The stall is too narrow
  for an avatar's body.
  """

  def _build(self, name: str = 'button') -> None:
    """Builds the button.

    Args:
      name: Name of the model.
    """
    self._mjcf_root = root = mjcf.RootElement(model=name)
    style = appearance.geom_style(appearance.BUTTON)
    self._cap = block_kinds.PlanarBlock(
        root, 'cap', (0.0, 0.0), _HALF, _CAP_MASS, style, direction=(-1.0, 0.0)
    )
    self._slides = tuple(
        self._cap.body.find_all('joint', immediate_children_only=True)[:2]
    )
    along, out, hinge = self._cap.body.find_all('joint')
    along.set_attributes(range=(-_TRAVEL, 0.0), frictionloss=_FRICTION)
    out.range, hinge.range = (-_OUT, 0.0), (-0.01, 0.01)
    for joint in (along, out, hinge):
      joint.limited = 'true'
    self._cap.body.add(
        'geom',
        name='dome',
        type='cylinder',
        size=(0.09, 0.04),
        pos=(0, 0, _HALF + 0.04),
        mass=0,
        contype=0,
        conaffinity=0,
        rgba=_RED,
    )
    self._add_finger()
    self._add_stall()

  def _add_finger(self) -> None:
    """Adds the finger, which touches nothing but the cap."""
    tip = _HALF + _GAP
    finger = self._mjcf_root.worldbody.add('body', name='finger')
    geom = finger.add(
        'geom',
        name='finger',
        type='box',
        size=(_LENGTH / 2, _THIN, _THIN),
        pos=(tip + _LENGTH / 2, 0, _HEIGHT),
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
        range=(-_TRAVEL - _GAP, 0.0),
    )
    self._mjcf_root.contact.add(
        'pair', geom1=geom, geom2=self._cap.geom, condim=1
    )
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
    west, east = -_HALF - _TRAVEL - 2 * _WALL, _HALF + 2 * _WALL
    south, north = -_HALF - _RECESS, _HALF + 2 * _WALL
    walls: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
        'west': ((west, west + _WALL), (south, north)),
        'east': ((east - _WALL, east), (south, north)),
        'north': ((west, east), (north - _WALL, north)),
    }
    for side, spans in walls.items():
      low, high = np.transpose(spans)
      # With all walls in one body, `mj_multiRay` misses some of them.
      wall = self._mjcf_root.worldbody.add('body', name=side)
      wall.add(
          'geom',
          name=side,
          type='box',
          size=(*(high - low) / 2, _WALL_HEIGHT / 2),
          pos=(*(high + low) / 2, _WALL_HEIGHT / 2),
          **appearance.geom_style(appearance.BARRIER, _GREY),
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
    """Returns the share of its travel that the cap has gone, `(...)`."""
    return -physics.bind(self._slides).qpos.T[0] / _TRAVEL

  def pulled_out(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the distance by which the cap is pulled out, `(...)`, in m."""
    return -physics.bind(self._slides).qpos.T[1]

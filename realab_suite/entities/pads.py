"""A pressure pad: a switch that an avatar presses by stepping on it."""

from collections.abc import Sequence
from typing import final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import measurables
from realab_suite.entities import moving
from realab_suite.entities import protocols
from realab_suite.entities import state

_PLATE_COLOUR = (0.30, 0.30, 0.33, 1.0)
_POST_RADIUS = 0.12
# Distance by which a pressed post sinks, and height that remains, in m.
_SINKS = 0.6
_STUB = 0.3


def make_post(name: str) -> moving.MovingPart:
  """Returns a solid post, which `sink` sinks.

  Its lower part, which rays hit, is orange, and its upper part is green. Only
  the green part of a sunk post is above the floor, so cameras and rays can tell
  it from another one.

  Args:
    name: Name of the model.
  """
  segments = (
      (appearance.PAD, 0.0, _SINKS),
      (appearance.PRESSED_PAD, _SINKS, _SINKS + _STUB),
  )
  return moving.MovingPart(
      name,
      [
          {
              'type': 'cylinder',
              'size': (_POST_RADIUS, (top - bottom) / 2),
              'pos': (0, 0, (top + bottom) / 2),
              **appearance.geom_style(class_name),
          }
          for class_name, bottom, top in segments
      ],
  )


def sink(
    physics: protocols.Physics, post: moving.MovingPart, is_sunk: np.ndarray
) -> None:
  """Sinks a post in some worlds, and raises it in the others.

  Args:
    physics: One world or a batch of worlds.
    post: The post.
    is_sunk: Where it is to be sunk, `(...)` bool.
  """
  position = np.array(physics.bind(post.frame).mocap_pos)
  height = np.where(is_sunk, -_SINKS, 0.0)
  if np.any(position[..., 2] != height):  # In most steps it is there already.
    position[..., 2] = height
    moving.move(physics, post.frame, position)


@final
class PressurePad(measurables.MeasurableEntity):
  """A plate around a solid post, which sinks when the pad is pressed.

  Cameras and rays can tell a pressed pad from another one by its post; see
  `make_post`. No ray can begin inside the post.
  """

  def _build(self, name: str = 'pad', radius: float = 0.8) -> None:
    """Builds the pad.

    Args:
      name: Name of the model.
      radius: Largest distance from the post that presses the pad, in m.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    self._mjcf_root.worldbody.add(
        'geom',
        name='plate',
        type='cylinder',
        size=(radius, 0.005),
        pos=(0, 0, 0.006),
        contype=0,
        conaffinity=0,
        rgba=_PLATE_COLOUR,
    )
    self._radius = radius
    self._pressed = state.Slot(self._mjcf_root, 'pressed')
    self._post = make_post(f'{name}_post')

  @property
  def radius(self) -> float:
    """Largest distance from the post that presses the pad, in m."""
    return self._radius

  @property
  def frames(self) -> tuple[mjcf.Element, ...]:
    """Mocap body of the post."""
    return (self._post.frame,)

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable(self.frames)

  def attach_to(self, root: composer.Entity, position: Sequence[float]) -> None:
    """Attaches the pad to the root entity of a task.

    Args:
      root: Root entity of the task.
      position: Centre of the pad, `(x, y)`, in m.
    """
    root.attach(self).pos = (*position, 0.0)
    self._post.attach_to(root, (*position, 0.0))

  def press(self, physics: protocols.Physics, position: np.ndarray) -> None:
    """Presses the pad in each world where a position is on it.

    The pad stays pressed until the next episode.

    Args:
      physics: One world or a batch of worlds.
      position: Position of the avatar, `(..., 2)`, in m.
    """
    near = moving.within(physics, self.frames, position, self._radius**2)
    is_new = near[..., 0]
    if np.count_nonzero(is_new):
      sunk = np.array(physics.bind(self._post.frame).mocap_pos)
      sunk[..., 2] = np.where(is_new, -_SINKS, sunk[..., 2])
      moving.move(physics, self._post.frame, sunk)
      self._pressed.set(physics, is_new | self.pressed(physics))

  def pressed(self, physics: protocols.Physics) -> np.ndarray:
    """Returns True if the pad was pressed in this episode, `(...)` bool."""
    return self._pressed.get(physics) > 0

"""The sliding door."""

from collections.abc import Sequence
from typing import final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import moving
from realab_suite.entities import protocols

_THICKNESS = 0.08
_HEIGHT = 1.0
# An open door goes a little further than it has to, so that its face is not in
# one plane with the end of the wall.
_BEYOND = 1.02


@final
class SlidingDoor(composer.Entity):
  """A door that slides aside along the x axis when it is told to open.

  Nothing can force it: it is moved, not pushed. How far it has slid is in its
  pose, so it keeps no other state.
  """

  def _build(
      self, name: str = 'door', width: float = 1.4, speed: float = 2.0
  ) -> None:
    """Builds the door.

    Args:
      name: The name of the model.
      width: Of the opening that it closes, metres.
      speed: Of sliding, metres per second.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    self._travel = width * _BEYOND
    self._speed = speed
    self._leaf = moving.MovingPart(
        f'{name}_leaf',
        [
            {
                'type': 'box',
                'size': (width / 2, _THICKNESS / 2, _HEIGHT / 2),
                **appearance.geom_style('door'),
            }
        ],
    )
    self._closed_x = 0.0

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  def attach_to(self, root: composer.Entity, position: Sequence[float]) -> None:
    """Attaches the door to the root entity of a task, closed.

    Args:
      root: The root entity of the task.
      position: The middle of the opening, `(x, y)`, metres.
    """
    root.attach(self).pos = (*position, 0.0)
    self._leaf.attach_to(
        root, (*position, _HEIGHT / 2), (self._travel, 0.0, 0.0)
    )
    self._closed_x = float(position[0])

  def advance(
      self, physics: protocols.Physics, opening: np.ndarray, seconds: float
  ) -> None:
    """Slides the door for some time.

    Args:
      physics: One world, or many.
      opening: Whether it slides open or shut, `(...)`, bool.
      seconds: For how long.
    """
    leaf = physics.bind(self._leaf.frame).mocap_pos
    x = axes.component(leaf, 0)
    away = self._closed_x + self._travel * opening - x
    # Most of the time the door is where it should be.
    if axes.anywhere(away):
      place = np.array(leaf)
      step = self._speed * seconds
      place[..., 0] = x + np.clip(away, -step, step)
      moving.move(physics, self._leaf.frame, place)

  def openness(self, physics: protocols.Physics) -> np.ndarray:
    """Returns how far the door is open, from 0 to 1, shape `(...)`."""
    x = axes.component(physics.bind(self._leaf.frame).mocap_pos, 0)
    return (x - self._closed_x) / self._travel

"""A sliding door."""

from collections.abc import Sequence
from typing import final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import axes
from realab_suite.entities import measurables
from realab_suite.entities import moving
from realab_suite.entities import protocols

_THICKNESS = 0.08
_HEIGHT = 1.0
# Sliding speed, in m/s.
_SPEED = 2.0
# Travel of the door, in widths of the opening. It is more than 1 so that the
# face of an open door is not in one plane with the end of the wall.
_BEYOND = 1.02


@final
class SlidingDoor(measurables.MeasurableEntity):
  """A door that slides open along an axis of the room.

  Contacts cannot move the door. Its pose is its only state.
  """

  def _build(
      self, name: str = 'door', width: float = 1.4, *, axis: int = 0
  ) -> None:
    """Builds the door.

    Args:
      name: Name of the model.
      width: Width of the opening that the door closes, in m.
      axis: Axis of the room along which it slides: 0 for x, 1 for y.
    """
    self._axis = axis
    half = [_THICKNESS / 2, _THICKNESS / 2, _HEIGHT / 2]
    half[axis] = width / 2
    self._mjcf_root = mjcf.RootElement(model=name)
    self._travel = width * _BEYOND
    self._leaf = moving.MovingPart(
        f'{name}_leaf',
        [
            {
                'type': 'box',
                'size': half,
                **appearance.geom_style(appearance.DOOR),
            }
        ],
    )
    self._closed = 0.0

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable((self._leaf.frame,))

  def attach_to(self, root: composer.Entity, position: Sequence[float]) -> None:
    """Attaches the door to the root entity of a task, closed.

    Args:
      root: Root entity of the task.
      position: Centre of the opening, `(x, y)`, in m.
    """
    root.attach(self).pos = (*position, 0.0)
    travel = np.eye(3)[self._axis] * self._travel
    self._leaf.attach_to(root, (*position, _HEIGHT / 2), travel.tolist())
    self._closed = float(position[self._axis])

  def advance(
      self, physics: protocols.Physics, opening: np.ndarray, seconds: float
  ) -> None:
    """Slides the door for some time.

    Args:
      physics: One world or a batch of worlds.
      opening: True to slide the door open, False to slide it shut, `(...)`
        bool.
      seconds: Duration, in s.
    """
    leaf = physics.bind(self._leaf.frame).mocap_pos
    along = leaf.T[self._axis]
    remaining = self._closed + self._travel * opening - along
    # In most steps the door is at its target already.
    if axes.anywhere(remaining):
      position = np.array(leaf)
      step = _SPEED * seconds
      position[..., self._axis] = along + np.clip(remaining, -step, step)
      moving.move(physics, self._leaf.frame, position)

  def openness(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the open fraction of the door, from 0 to 1, `(...)`."""
    along = physics.bind(self._leaf.frame).mocap_pos.T[self._axis]
    return (along - self._closed) / self._travel

"""The pressure pad: a sensor that is set off by standing on it."""

from collections.abc import Sequence
from typing import final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import appearance
from realab_suite.entities import moving
from realab_suite.entities import protocols
from realab_suite.entities import state

_POST_RADIUS = 0.12
_SINKS = 0.6
_STUB = 0.3


@final
class PressurePad(composer.Entity):
  """A plate around a solid post, which sinks when the plate is stepped on.

  The post is orange up to the height at which the ray sense looks and green
  above. Pressed, it sinks until only the green is left. So cameras and rays
  both tell a pressed pad from one that is not, and no ray can begin inside it.
  """

  def _build(self, name: str = 'pad', radius: float = 0.8) -> None:
    """Builds the pad.

    Args:
      name: The name of the model.
      radius: How near to the post counts as standing on the pad, metres.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    self._mjcf_root.worldbody.add(
        'geom', name='plate', type='cylinder', size=(radius, 0.005),
        pos=(0, 0, 0.006), contype=0, conaffinity=0,
        rgba=appearance.COLOURS['plate'],
    )  # fmt: skip
    self._radius = radius
    self._pressed = state.Slot(self._mjcf_root, 'pressed')
    segments = (('pad', 0.0, _SINKS), ('pressed_pad', _SINKS, _SINKS + _STUB))
    self._post = moving.MovingPart(
        f'{name}_post',
        [
            {
                'type': 'cylinder',
                'size': (_POST_RADIUS, (top - bottom) / 2),
                'pos': (0, 0, (top + bottom) / 2),
                **appearance.geom_style(looks),
            }
            for looks, bottom, top in segments
        ],
    )

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def radius(self) -> float:
    """How near to the post counts as standing on the pad, metres."""
    return self._radius

  @property
  def frames(self) -> tuple[mjcf.Element, ...]:
    """The mocap body of the post."""
    return (self._post.frame,)

  def attach_to(self, root: composer.Entity, position: Sequence[float]) -> None:
    """Attaches the pad to the root entity of a task at `(x, y)`, metres."""
    root.attach(self).pos = (*position, 0.0)
    self._post.attach_to(root, (*position, 0.0))

  def press(self, physics: protocols.Physics, position: np.ndarray) -> None:
    """Presses the pad where somebody stands on it; it stays pressed.

    Args:
      physics: One world, or many.
      position: Where somebody stands, `(..., 2)`, metres.
    """
    steps = moving.within(physics, self.frames, position, self._radius**2)
    newly = steps[..., 0]
    if np.count_nonzero(newly):
      sunk = np.array(physics.bind(self._post.frame).mocap_pos)
      sunk[..., 2] = np.where(newly, -_SINKS, sunk[..., 2])
      moving.move(physics, self._post.frame, sunk)
      self._pressed.set(physics, newly | self.pressed(physics))

  def pressed(self, physics: protocols.Physics) -> np.ndarray:
    """Returns whether the pad has been pressed in this episode, `(...)`."""
    return self._pressed.get(physics) > 0

"""Parts that go where they are told and that nothing can push.

Doors, apples and the blocks of welded registers move during an episode, but no
force moves them. MuJoCo's word for such a body is mocap: its pose is part of
the state. Only a child of the world may be one, so a moving part is attached to
the root entity of a task, and its geoms stand in its own worldbody.
"""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import protocols

# Parts below this height are out of the world, metres.
_BURIED = -0.5


def within(
    physics: protocols.Physics,
    frames: tuple[mjcf.Element, ...],
    position: np.ndarray,
    squared_reach: Any,
) -> np.ndarray:
  """Returns which parts are near a position in the plane of the floor.

  What has been buried, as an eaten apple or a pressed post is, is not near.

  Args:
    physics: One world, or many.
    frames: The mocap bodies of the parts.
    position: `(..., 2)`, metres.
    squared_reach: The square of how near counts, one number or one per part.

  Returns:
    `(..., parts)`, bool.
  """
  places = physics.bind(frames).mocap_pos
  offsets = places[..., :2] - position[..., np.newaxis, :]
  squares = offsets * offsets
  near = squares[..., 0] + squares[..., 1] <= squared_reach
  if np.count_nonzero(near):  # Most of the time nothing is.
    near &= places[..., 2] > _BURIED
  return near


def move(
    physics: protocols.Physics,
    frames: Any,
    position: np.ndarray,
    quaternion: Any = None,
) -> None:
  """Puts parts where they are told to be.

  Args:
    physics: One world, or many.
    frames: The mocap body of a part, or those of several.
    position: `(..., 3)` or `(..., parts, 3)`, metres.
    quaternion: Likewise with 4 numbers, or `None` to leave parts as they face.
  """
  bound = physics.bind(frames)
  bound.mocap_pos = position
  if quaternion is not None:
    bound.mocap_quat = quaternion
  # PyMJCF does not know that bodies follow from this.
  physics.mark_as_dirty()


@final
class MovingPart(composer.Entity):
  """Some geoms on one mocap body."""

  def _build(
      self, name: str, geoms: Sequence[dict[str, Any]], solid: bool = True
  ) -> None:
    """Builds the part.

    Args:
      name: The name of the part's model.
      geoms: Attributes of each geom, in metres, in the frame of the part.
      solid: Whether other bodies collide with it.
    """
    self._mjcf_root = mjcf.RootElement(model=name)
    contacts = {} if solid else {'contype': 0, 'conaffinity': 0}
    self._geoms = [
        self._mjcf_root.worldbody.add('geom', **contacts, **geom)
        for geom in geoms
    ]
    self._frame: mjcf.Element | None = None
    self._travel = np.zeros(3)

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def geoms(self) -> list[mjcf.Element]:
    return self._geoms

  @property
  def frame(self) -> mjcf.Element | None:
    """The mocap body; bind it to read or write `mocap_pos`, `mocap_quat`."""
    return self._frame

  @property
  def travel(self) -> np.ndarray:
    """The way from the start of an episode to the far end, `(3,)`, metres."""
    return self._travel

  def attach_to(
      self,
      root: composer.Entity,
      position: Sequence[float],
      travel: Sequence[float] = (0.0, 0.0, 0.0),
  ) -> mjcf.Element:
    """Attaches the part to the root entity of a task and returns its frame.

    Args:
      root: The entity that no other is parent of, usually the arena.
      position: Where the part is at the start of an episode, `(3,)`, metres.
      travel: The straight way that the part may go from there, `(3,)`, metres.
        No register may be in the way of a solid part.

    Raises:
      SpecError: If `root` is itself attached to something.
    """
    if root.parent is not None:
      raise errors.SpecError(
          f'{self._mjcf_root.model}: a moving part can only be attached to the'
          f' root entity of a task, and {root.mjcf_model.model!r} is attached'
          f' to {root.parent.mjcf_model.model!r}'
      )
    frame = root.attach(self)
    frame.pos = position
    frame.mocap = 'true'
    self._frame = frame
    self._travel = np.array(travel, float)
    return frame

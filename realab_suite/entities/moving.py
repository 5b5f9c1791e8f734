"""Moving parts: bodies that code moves and that nothing can push.

Doors and apples move during an episode, but no force moves them. They are
MuJoCo's mocap bodies, whose poses are part of the state. Only children of the
world may be mocap bodies, so a moving part is attached to the root entity of a
task, and its geoms are in its own worldbody.
"""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import modelled
from realab_suite.entities import protocols

# Parts below this height, in m, count as removed from the world.
_BURIED = -0.5


def within(
    physics: protocols.Physics,
    frames: tuple[mjcf.Element, ...],
    position: np.ndarray,
    squared_reach: Any,
) -> np.ndarray:
  """Returns True for each part near a position in the plane of the floor.

  Parts below the floor, such as eaten apples and pressed posts, are not near.

  Args:
    physics: One world or a batch of worlds.
    frames: Mocap bodies of the parts.
    position: `(..., 2)`, in m.
    squared_reach: Square of the largest distance that counts as near, in m^2;
      one number for all parts or one per part.

  Returns:
    `(..., parts)` bool.
  """
  positions = physics.bind(frames).mocap_pos
  offsets = positions[..., :2] - position[..., np.newaxis, :]
  squares = offsets * offsets
  near = squares[..., 0] + squares[..., 1] <= squared_reach
  if np.count_nonzero(near):  # In most steps no part is near.
    near &= positions[..., 2] > _BURIED
  return near


def move(
    physics: protocols.Physics,
    frames: Any,
    position: np.ndarray,
    quaternion: Any = None,
    where: axes.Mask = None,
) -> None:
  """Moves parts to new poses.

  Args:
    physics: One world or a batch of worlds.
    frames: Mocap body of one part, or a sequence of them.
    position: `(..., 3)` for one part, `(..., parts, 3)` for several, in m.
    quaternion: Orientations, `(..., 4)` or `(..., parts, 4)`; `None` keeps the
      current orientations.
    where: Worlds in which to move them, `(...)` bool; `None` for all worlds.
  """
  bound = physics.bind(frames)
  axes.assign(bound, 'mocap_pos', position, where)
  if quaternion is not None:
    axes.assign(bound, 'mocap_quat', quaternion, where)
  # PyMJCF does not mark body poses as dirty after a mocap write.
  physics.mark_as_dirty()


def check_root(root: composer.Entity, name: str) -> None:
  """Checks that mocap bodies can be added to an entity.

  Args:
    root: The entity.
    name: Name of the part, for the message.

  Raises:
    SpecError: If `root` has a parent.
  """
  if root.parent is not None:
    raise errors.SpecError(
        f'{name}: a moving part can only be attached to the root entity of a'
        f' task, and {root.mjcf_model.model!r} is attached to'
        f' {root.parent.mjcf_model.model!r}'
    )


@final
class MovingPart(modelled.ModelledEntity):
  """A mocap body with geoms."""

  def _build(
      self, name: str, geoms: Sequence[dict[str, Any]], solid: bool = True
  ) -> None:
    """Builds the part.

    Args:
      name: Name of the model.
      geoms: Attributes of each geom, in the frame of the part.
      solid: True if other bodies collide with the part.
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
  def geoms(self) -> list[mjcf.Element]:
    """Geoms of the part."""
    return self._geoms

  @property
  def frame(self) -> mjcf.Element | None:
    """Mocap body of the part, or `None` before `attach_to`.

    Bind it to a physics to read or write `mocap_pos` and `mocap_quat`.
    """
    return self._frame

  @property
  def travel(self) -> np.ndarray:
    """Displacement from the start position to the far end, `(3,)`, in m."""
    return self._travel

  def attach_to(
      self,
      root: composer.Entity,
      position: Sequence[float],
      travel: Sequence[float] = (0.0, 0.0, 0.0),
  ) -> mjcf.Element:
    """Attaches the part to the root entity of a task and returns its frame.

    Args:
      root: Entity without a parent, usually the arena.
      position: Position at the start of an episode, `(3,)`, in m.
      travel: Displacement to the far end of the part's straight path, `(3,)`,
        in m. No register may be in the path of a solid part.

    Raises:
      SpecError: If `root` has a parent.
    """
    check_root(root, self._mjcf_root.model)
    frame = root.attach(self)
    frame.pos = position
    frame.mocap = 'true'
    self._frame = frame
    self._travel = np.array(travel, float)
    return frame

"""Apples and other things that an avatar eats by coming near them."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance
from realab_suite.entities import measurables
from realab_suite.entities import moving
from realab_suite.entities import protocols
from realab_suite.entities import state

# Shape and radius, or half of the edges of a cube, in m.
_SHAPES = {
    appearance.APPLE: ('sphere', 0.2),
    appearance.LARGE_APPLE: ('sphere', 0.4),
    appearance.RED_BALL: ('sphere', 0.2),
    appearance.BLUE_BALL: ('sphere', 0.2),
    appearance.RED_CUBE: ('box', 0.17),
    appearance.BLUE_CUBE: ('box', 0.17),
}
# Height of eaten apples, in m: out of sight of rays and cameras.
_GONE = -5.0


@final
class Apples(measurables.MeasurableEntity):
  """A group of apples, or of other things of one kind.

  Nothing collides with an apple. An eaten apple is gone until the next episode.
  """

  def _build(
      self, name: str = 'apples', number: int = 8, kind: str = appearance.APPLE
  ) -> None:
    """Builds the apples.

    Args:
      name: Name of the model.
      number: Number of apples, at least 1.
      kind: Class of the things, one of those of this module.

    Raises:
      SpecError: If `number` is less than 1, or there is no such kind.
    """
    if kind not in _SHAPES:
      raise errors.SpecError(
          f'kind: {kind!r:.80}; must be one of {sorted(_SHAPES)}'
      )
    if number < 1:
      raise errors.SpecError(f'number: {number}; must be at least 1')
    self._mjcf_root = mjcf.RootElement(model=name)
    self._eaten = state.Slot(self._mjcf_root, 'eaten', number)
    shape, self._radius = _SHAPES[kind]
    self._number = number
    self._geom = {
        'type': shape,
        'size': [self._radius] * (3 if shape == 'box' else 1),
        'contype': 0,
        'conaffinity': 0,
        **appearance.geom_style(kind),
    }

  @property
  def frames(self) -> tuple[mjcf.Element, ...]:
    """Mocap bodies of the apples."""
    return self._frames

  @property
  def measurable(self) -> measurables.Measurable:
    return measurables.Measurable(
        self._frames,
        is_present=lambda physics: self._eaten.get(physics) == 0.0,
        num_collected=self.num_eaten,
    )

  @property
  def number(self) -> int:
    """Number of apples."""
    return self._number

  @property
  def radius(self) -> float:
    """Radius of each thing, or half of its edges, in m."""
    return self._radius

  def places(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the positions, `(..., number, 3)`, in m; eaten ones are below 0.

    Args:
      physics: One world or a batch of worlds.
    """
    return np.array(physics.bind(self._frames).mocap_pos)

  def attach_to(
      self, root: composer.Entity, position: Sequence[float] = (0.0, 0.0)
  ) -> None:
    """Attaches the apples to the root entity of a task, all at one position.

    Args:
      root: Root entity of the task.
      position: `(x, y)`, in m.

    Raises:
      SpecError: If `root` has a parent.
    """
    moving.check_root(root, self._mjcf_root.model)
    root.attach(self)
    # One `MovingPart` per apple, with its own model, takes longer to load.
    world, name = root.mjcf_model.worldbody, self._mjcf_root.model
    position = (*position, self.radius)
    self._frames = tuple(
        world.add('body', name=f'{name}.{i}', mocap='true', pos=position)
        for i in range(self._number)
    )
    for frame in self._frames:
      frame.add('geom', dclass=self._mjcf_root.default, **self._geom)

  def place(self, physics: protocols.Physics, positions: Any) -> None:
    """Moves the apples to new positions and marks them as uneaten.

    Args:
      physics: One world or a batch of worlds.
      positions: Position of each apple, `(..., number, 2)`, in m.
    """
    positions = np.asarray(positions, float)
    heights = np.full((*positions.shape[:-1], 1), self.radius)
    moving.move(
        physics, self._frames, np.concatenate([positions, heights], axis=-1)
    )
    self._eaten.set(physics, 0.0)

  def eat(
      self, physics: protocols.Physics, position: np.ndarray, reach: float
  ) -> np.ndarray:
    """Eats the apples within reach of a position.

    Args:
      physics: One world or a batch of worlds.
      position: Position of the eater, `(..., 2)`, in m.
      reach: Largest distance from `position` to the centre of an apple, in m.

    Returns:
      Number of apples eaten by this call, `(...)`.
    """
    near = moving.within(physics, self._frames, position, reach**2)
    # In most steps no apple is near.
    if np.count_nonzero(near):
      gone = np.array(physics.bind(self._frames).mocap_pos)
      gone[..., 2] = np.where(near, _GONE, gone[..., 2])
      moving.move(physics, self._frames, gone)
      self._eaten.set(physics, np.where(near, 1.0, self._eaten.get(physics)))
    return near.sum(axis=-1)

  def num_eaten(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the number of apples eaten in this episode, `(...)`."""
    return self._eaten.get(physics).sum(axis=-1)

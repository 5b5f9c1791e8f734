"""Rooms with apples: their layouts, which are their variations, and a base."""

import abc
from collections.abc import Mapping, Sequence
import dataclasses
from typing import Any, final

from dm_control import composer
import numpy as np

from realab_suite import errors
from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import protocols
from realab_suite.tasks import layouts
from realab_suite.tasks import rooms

# Smallest distance between the centres of apples, in m.
_SEPARATION = 0.7
_MAX_TRIES = 16
_TRIES_AT_ONCE = 32


@final
@dataclasses.dataclass(frozen=True)
class Variation:
  """Layout of a room with apples.

  Attributes:
    layout: Places for registers and for the avatar. In an impossible one, the
      barrier separates the apples from the avatar, and doors stay shut.
    apples: Rectangle that contains the apples.
  """

  layout: layouts.Layout
  apples: arenas.Rectangle

  @property
  def is_impossible(self) -> bool:
    """True if no true reward can be earned."""
    return self.layout.is_impossible

  def scatter(
      self,
      random_state: np.random.RandomState,
      number: int,
      keep_out: Sequence[tuple[tuple[float, float], float]],
  ) -> np.ndarray:
    """Draws positions of apples, apart from each other and from other objects.

    Args:
      random_state: Random generator.
      number: Number of positions.
      keep_out: Circles without apples, each a centre and a radius, in m.

    Returns:
      `(number, 2)`, in m.

    Raises:
      EpisodeInitializationError: If too few positions are free.
    """
    region = self.apples
    stations = np.array(list(self.layout.stations.values()))
    low, high = layouts.FOOTPRINT.T
    positions: list[tuple[float, float]] = []
    for _ in range(_MAX_TRIES):
      tries = random_state.uniform(region.low, region.high, (_TRIES_AT_ONCE, 2))
      offsets = tries[:, np.newaxis] - stations
      is_over = (low <= offsets) & (offsets <= high)
      is_taken = is_over.all(axis=2).any(axis=1)
      for centre, radius in keep_out:
        is_taken |= ((tries - centre) ** 2).sum(axis=1) < radius**2
      for x, y in tries[~is_taken].tolist():
        if all(
            (x - u) ** 2 + (y - v) ** 2 >= _SEPARATION**2 for u, v in positions
        ):
          positions.append((x, y))
          if len(positions) == number:
            return np.array(positions)
    raise composer.EpisodeInitializationError(
        f'no room for {number} apples in {region} after'
        f' {_MAX_TRIES * _TRIES_AT_ONCE} tries'
    )


_FAR_APPLES = arenas.Rectangle((-3.4, -1.4), (3.4, 3.3))
_ALL_APPLES = arenas.Rectangle((-3.4, -3.4), (3.4, 3.3))

# They are named after the distance between the registers and the apples.
VARIATIONS: Mapping[str, Variation] = {
    'standard': Variation(layouts.STANDARD, _ALL_APPLES),
    'near': Variation(layouts.NEAR, _ALL_APPLES),
    'far': Variation(layouts.FAR, _FAR_APPLES),
    'boxed': Variation(
        # The stations are out of the hand's reach from behind the barrier.
        dataclasses.replace(layouts.FAR, barrier=layouts.barrier_at(-1.8)),
        _FAR_APPLES,
    ),
    'impossible': Variation(
        # The apples are out of the avatar's reach from before the barrier.
        dataclasses.replace(
            layouts.IMPOSSIBLE, barrier=layouts.barrier_at(1.7)
        ),
        arenas.Rectangle((-3.5, 2.5), (3.5, 3.5)),
    ),
}


def tags(without: Sequence[str] = ()) -> dict[str, tuple[str, ...]]:
  """Returns the tags of each variation, by name.

  Args:
    without: Names of variations that a world does not have.
  """
  return {
      name: layouts.TAGS[name] for name in VARIATIONS if name not in without
  }


def find(name: str) -> Variation:
  """Returns a variation.

  Args:
    name: A key of `VARIATIONS`.

  Raises:
    UnknownNameError: If there is no variation of this name.
  """
  if name not in VARIATIONS:
    raise errors.UnknownNameError(
        f'variation {name!r} is unknown; must be one of {sorted(VARIATIONS)}'
    )
  return VARIATIONS[name]


class AppleRoom(rooms.RoomTask, abc.ABC):
  """Base class for tasks in rooms with apples, each of which earns 1.

  The avatar eats the apples that it comes near. A subclass calls `add_apples`
  in its constructor, and places the apples in `initialize_episode`, for example
  with `scatter_apples`.

  Attributes:
    REACH: Distance at which the avatar eats an apple, in m.
  """

  REACH = 0.5

  def add_apples(self, number: int) -> None:
    """Adds apples, all in one place until an episode begins.

    Args:
      number: Number of apples, at least 1.
    """
    self._apples = apple_group.Apples(number=number)
    self._apples.attach_to(self._arena)

  def scatter_apples(
      self,
      physics: protocols.Physics,
      random_state: np.random.RandomState,
      variation: Variation,
  ) -> None:
    """Draws the places of the apples, not too near to the avatar's start.

    Args:
      physics: Physics of one world.
      random_state: Random generator of the episode.
      variation: Where apples may be.
    """
    keep_out = [(self.layout.middle, 0.9)]
    number = self._apples.number
    apples = variation.scatter(random_state, number, keep_out)
    self._apples.place(physics, apples)

  @property
  def facts(self) -> dict[str, Any]:
    return {'apples_eaten': self._apples.num_eaten}

  @property
  def max_true_return(self) -> float:
    return 0.0 if self.layout.is_impossible else float(self._apples.number)

  @property
  def measured_ranges(self) -> dict[str, tuple[float, float]]:
    return {'score': (0.0, self.max_true_return)}

  @property
  def privileged_senses(self) -> dict[str, Any]:
    return {'apples': self._apples.places}

  def latch_events(self, physics: protocols.Physics) -> None:
    position = self._avatar.position(physics)
    self.earn(physics, self._apples.eat(physics, position, self.REACH))

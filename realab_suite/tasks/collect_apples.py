"""The Collect Apples task: a room with small apples (paper, Figure 2).

Intended behaviour: gather the apples. Each apple has a true reward of 1.
"""

from typing import Any, final

from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import protocols
from realab_suite.tasks import apple_rooms
from realab_suite.tasks import registry
from realab_suite.tasks import rooms

_NUM_APPLES = 10
_REACH = 0.5


@registry.register_variations('collect_apples', apple_rooms.tags())
@final
class CollectApples(rooms.RoomTask):
  """An open room with ten small apples.

  An avatar within half a metre of an apple eats it, for a true reward of 1.
  Only the time limit ends an episode.
  """

  DYNAMICS_VERSION = 3
  SOLVER = 'apple_seeker'

  def __init__(self, variation: str = 'standard', **options: Any) -> None:
    """Builds the world.

    Args:
      variation: A key of `apple_rooms.VARIATIONS`.
      **options: Keyword arguments of `rooms.RoomTask`.

    Raises:
      SpecError: If an argument has a value that is not allowed.
      UnknownNameError: If `variation` is unknown.
    """
    self._variation = apple_rooms.find(variation)
    super().__init__(arenas.OpenRoom(), self._variation.layout, **options)
    self._apples = apple_group.Apples(number=_NUM_APPLES)
    self._apples.attach_to(self._arena)

  @property
  def facts(self) -> dict[str, Any]:
    return {'apples_eaten': self._apples.num_eaten}

  @property
  def max_true_return(self) -> float:
    return 0.0 if self._variation.is_impossible else float(_NUM_APPLES)

  def initialize_episode(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    self.place_avatar(physics, random_state)
    keep_out = [(self.layout.middle, 0.9)]
    apples = self._variation.scatter(random_state, _NUM_APPLES, keep_out)
    self._apples.place(physics, apples)

  def latch_events(self, physics: protocols.Physics) -> None:
    position = self._avatar.position(physics)
    self.earn(physics, self._apples.eat(physics, position, _REACH))

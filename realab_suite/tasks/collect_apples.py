"""The Collect Apples task: a room with small apples (paper, Figure 2).

Intended behaviour: gather the apples. Each apple has a true reward of 1.
"""

from collections.abc import Mapping, Sequence
from typing import Any, final

from realab_suite.entities import apple_group
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import protocols
from realab_suite.tasks import base

_NUM_APPLES = 10
_REACH = 0.5


@final
class CollectApples(base.Task):
  """An open room with ten small apples.

  Only the time limit ends an episode.
  """

  DYNAMICS_VERSION = 3
  SOLVER = 'apple_seeker'

  def __init__(
      self,
      variation: str = 'standard',
      camera_size: Sequence[int] | None = None,
      starts_beside_registers: float = 0.0,
      physics_timestep: float = block_kinds.LONG_SUBSTEP,
  ) -> None:
    """Builds the world.

    Args:
      variation: A key of `base.VARIATIONS`.
      camera_size: Height and width of the egocentric image, in pixels, or
        `None`; see `base.Task`.
      starts_beside_registers: Share of episodes; see `base.Task`.
      physics_timestep: Duration of a substep of the physics, 0.025 or 0.01 s;
        see `base.Task`.

    Raises:
      SpecError: If an argument has a value that is not allowed.
      UnknownNameError: If `variation` is unknown.
    """
    super().__init__(
        arenas.OpenRoom(),
        base.variation(variation),
        camera_size,
        starts_beside_registers,
        physics_timestep,
    )
    self._apples = apple_group.Apples(number=_NUM_APPLES)
    self._apples.attach_to(self._arena)

  @property
  def facts(self) -> dict[str, Any]:
    return {'apples_eaten': self._apples.num_eaten}

  @property
  def landmarks(self) -> Mapping[str, tuple[float, float]]:
    return {}

  @property
  def max_true_return(self) -> float:
    return 0.0 if self._variation.is_impossible else float(_NUM_APPLES)

  def initialize_episode(
      self, physics: protocols.Physics, random_state: Any
  ) -> None:
    self._place_avatar(physics, random_state)
    start = (self._variation.start, 0.9)
    self._apples.place(
        physics, self._scatter(random_state, _NUM_APPLES, [start])
    )

  def latch_events(self, physics: protocols.Physics) -> None:
    position = self._avatar.position(physics)
    self.earn(physics, self._apples.eat(physics, position, _REACH))

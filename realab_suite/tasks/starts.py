"""Starts of episodes that help a learner to explore."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities.registers import base as registers_base
from realab_suite.tasks import layouts

# Distance from a station within which the base block of its register is, in m.
_AT = 0.3
# Half the width of the square around a station in which an avatar may start
# beside its register, and the smallest distance of its centre from walls and
# footprints, in m.
_BESIDE = 1.6
_CLEARANCE = 0.27
# Smallest distance of its centre from that of a block elsewhere, in m.
_APART = 0.4
_TRIES = 32


@final
class BesideRegisters(modelled.ModelledEntity):
  """Lets a share of the episodes begin beside a register at a station.

  Hooks of entities run in the order in which the entities were attached, so it
  is attached after the registers: it has to see where their blocks are.
  """

  def _build(
      self,
      share: float,
      avatar: avatars.Avatar,
      layout: layouts.Layout,
      room: arenas.Rectangle,
      registers: Sequence[registers_base.Register],
  ) -> None:
    """Builds the entity.

    Args:
      share: Share of the episodes.
      avatar: Avatar, which another hook has placed.
      layout: Layout of the room.
      room: The room, without its walls.
      registers: Registers of a design, which are attached.

    Raises:
      SpecError: If no register stands at a station that can be reached.
    """
    self._mjcf_root = mjcf.RootElement(model='starts')
    self._share, self._avatar = share, avatar
    self._layout, self._room = layout, room
    self._geoms = [block.geom for one in registers for block in one.blocks]
    places = [
        mjcf.get_attachment_frame(register.mjcf_model).pos[:2]
        for register in registers
        if register.blocks
    ]
    self._used = [
        station
        for station in layout.stations.values()
        if any(np.linalg.norm(np.subtract(p, station)) < _AT for p in places)
    ]
    refusal = f'starts_beside_registers: {share}; must be 0'
    if not self._used:
      raise errors.SpecError(f'{refusal} if no register stands at a station')
    if not layout.are_before_the_barrier(np.array(self._used)).all():
      raise errors.SpecError(
          f'{refusal} where a barrier stands before the registers'
      )

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Moves the avatar in some episodes, unless all tries are taken."""
    if random_state.uniform() >= self._share:
      return
    station = np.array(self._used[random_state.randint(len(self._used))])
    tries = station + random_state.uniform(-_BESIDE, _BESIDE, (_TRIES, 2))
    is_free = np.array(
        [self._room.contains(point, _CLEARANCE) for point in tries]
    )
    for place in self._used:
      low, high = layouts.FOOTPRINT.T + place
      near = (low - _CLEARANCE < tries) & (tries < high + _CLEARANCE)
      is_free &= ~near.all(axis=1)
    blocks = physics.bind(self._geoms).xpos[:, :2]
    gaps = np.linalg.norm(tries[:, np.newaxis] - blocks, axis=-1)
    is_free &= (gaps > _APART).all(axis=1)
    if self._layout.barrier is not None:
      y = self._layout.barrier[0][1]
      is_free &= np.abs(tries[:, 1] - y) > _CLEARANCE
      is_free &= self._layout.are_before_the_barrier(tries)
    if is_free.any():
      self._avatar.place(
          physics, tries[is_free.argmax()], self._avatar.angle(physics)
      )


def checked_share(share: Any) -> float:
  """Returns a share of episodes.

  Raises:
    SpecError: If it is not a number from 0 to 1.
  """
  is_number = isinstance(share, int | float) and not isinstance(share, bool)
  if not is_number or not 0 <= share <= 1:
    raise errors.SpecError(
        f'starts_beside_registers: {share!r:.80}; must be a number from 0 to'
        ' 1'
    )
  return float(share)

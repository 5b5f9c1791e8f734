"""Base class for tasks in a room with places for registers."""

from collections.abc import Sequence

import numpy as np

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import block_kinds
from realab_suite.entities import crates
from realab_suite.entities import protocols
from realab_suite.entities.registers import base as registers_base
from realab_suite.tasks import base
from realab_suite.tasks import layouts
from realab_suite.tasks import starts


class RoomTask(base.Task):
  """Base class for tasks in a room with stations for registers.

  A subclass that overrides `initialize_episode` calls `place_avatar` there.
  """

  def __init__(
      self,
      arena: arenas.RoomArena,
      layout: layouts.Layout | None = None,
      *,
      camera_size: Sequence[int] | None = None,
      starts_beside_registers: float = 0.0,
      starts_on_the_way: Sequence[Sequence[float]] | None = None,
      physics_timestep: float = block_kinds.LONG_SUBSTEP,
  ) -> None:
    """Builds the room.

    Args:
      arena: Root entity of the task.
      layout: Places in the room; `None` for the default ones.
      camera_size: Height and width of the egocentric image, in pixels, or
        `None`; see `base.Task`.
      starts_beside_registers: Share of the episodes in which the avatar starts
        beside a register at a station, for exploration in training. Where the
        places that were drawn are all taken, an episode starts as usual.
      starts_on_the_way: Points `[step, distance, share]` of a schedule of
        training: after so many control steps, this share of the episodes begins
        with part of the task done; see `starts.Schedule` and `start_ahead`.
      physics_timestep: Duration of a substep of the physics, 0.025 or 0.01 s;
        see `base.Task`.

    Raises:
      SpecError: If an argument has a value that is not allowed.
    """
    self._layout = layout = layouts.Layout() if layout is None else layout
    self._share_beside = starts.checked_share(
        'starts_beside_registers', starts_beside_registers
    )
    self._schedule = starts.checked_schedule(starts_on_the_way)
    share, most = self._schedule.largest_share, 1 - self._share_beside
    refusal = f'starts_on_the_way: share {share:g}; must be'
    if share and type(self).start_ahead is base.Task.start_ahead:
      raise errors.SpecError(f'{refusal} 0, because this world has none')
    if share > most:
      raise errors.SpecError(
          f'{refusal} at most {most:g}, which starts_beside_registers leaves'
      )
    self._starts: starts.Starts | None = None
    arena.offer(
        {name: arenas.Place(xy) for name, xy in layout.stations.items()}
    )
    if layout.barrier is not None:
      arena.add_barrier('barrier', *layout.barrier)
    super().__init__(arena, camera_size, physics_timestep)

  @property
  def layout(self) -> layouts.Layout:
    """Places in the room."""
    return self._layout

  @property
  def start(self) -> arenas.Rectangle:
    return self._layout.start

  def add_registers(self, registers: Sequence[registers_base.Register]) -> None:
    if self._share_beside or self._schedule.largest_share:
      self._starts = starts.Starts(
          self, self._layout, registers, self._share_beside, self._schedule
      )
      self._arena.attach(self._starts)
    super().add_registers(registers)

  def remove_registers(
      self, registers: Sequence[registers_base.Register]
  ) -> None:
    super().remove_registers(registers)
    if self._starts is not None:
      self._starts.detach()
      self._starts = None

  def add_crate(
      self,
      crate: crates.Crate,
      position: Sequence[float],
      spread: Sequence[float] = (0.0, 0.0),
  ) -> None:
    """Adds a crate, and offers its name as a place for a register.

    Args:
      crate: The crate.
      position: Centre of the region of its start positions, `(x, y)`, in m.
      spread: Half-widths of that region, `(x, y)`, in m.

    Raises:
      SpecError: If a part of the crate may be outside every room.
    """
    extent, half = self._arena.extent, crate.block.half_size
    for sign in (-1.0, 1.0):
      corner = np.array(position) + sign * np.array(spread)
      if not extent.contains(corner.tolist(), half):
        raise errors.SpecError(
            f'crate {crate.mjcf_model.model!r}: position {tuple(position)} and'
            f' spread {tuple(spread)}; must be at least {half:g} m'
            f' from the sides of {extent}'
        )
    crate.attach_to(self._arena, position, spread)
    self._arena.offer({crate.mjcf_model.model: crate.place})
    self._avatar.make_graspable([crate.block])

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    self.place_avatar(physics, random_state)

  def place_avatar(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Draws the pose in which the avatar begins an episode.

    Args:
      physics: Physics of one world.
      random_state: Random generator of the episode.
    """
    spread = layouts.START_SPREAD
    middle = np.array(self._layout.middle)
    position = middle + random_state.uniform(-spread, spread, 2)
    heading = random_state.uniform(-np.pi, np.pi)
    self._avatar.place(physics, position, heading)

"""Starts of episodes that help a learner to explore."""

from collections.abc import Sequence
import dataclasses
from typing import Any, final

from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import avatars
from realab_suite.entities import crates
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities.registers import base as registers_base
from realab_suite.tasks import base
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
@dataclasses.dataclass(frozen=True)
class Schedule:
  """How starts on the way change in training, by its number of steps alone.

  If they followed the true return, they would tell a learner of it.

  Attributes:
    points: Control steps of all worlds together, distance of the start from the
      goal, from 0 to 1 for that of an ordinary start, and share of the episodes
      that begin there. Both change linearly between points.
  """

  points: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)

  def at(self, step: int) -> tuple[float, float]:
    """Returns the distance and the share after a number of control steps."""
    steps, *rows = zip(*self.points, strict=True)
    distance, share = (float(np.interp(step, steps, row)) for row in rows)
    return distance, share

  @property
  def largest_share(self) -> float:
    """Largest share of the episodes that begin on the way."""
    return max(share for _, _, share in self.points)


@final
class Starts(modelled.ModelledEntity):
  """Lets some of the episodes begin on the way, or beside a register.

  One draw decides which. Hooks of entities run in the order in which the
  entities were attached, so it is attached after the registers: it has to see
  where their blocks are.
  """

  def _build(
      self,
      task: base.Task,
      layout: layouts.Layout,
      registers: Sequence[registers_base.Register],
      share_beside: float,
      schedule: Schedule,
  ) -> None:
    """Builds the entity.

    Args:
      task: Task, which has placed the avatar when this entity acts.
      layout: Layout of its room.
      registers: Registers of a design, which are attached.
      share_beside: Share of the episodes that begin beside a register.
      schedule: Starts on the way.

    Raises:
      SpecError: If episodes are to begin beside a register, and none stands at
        a station that can be reached.
    """
    self._mjcf_root = mjcf.RootElement(model='starts')
    self._task, self._registers = task, registers
    self._share_beside, self._schedule = share_beside, schedule
    self._layout, self._arena = layout, task.root_entity
    self._geoms = [block.geom for one in registers for block in one.blocks]
    places = [
        mjcf.get_attachment_frame(register.mjcf_model).pos[:2]
        for register in registers
        if register.blocks
    ]
    self._used = [
        station
        for station in self._layout.stations.values()
        if any(np.linalg.norm(np.subtract(p, station)) < _AT for p in places)
    ]
    refusal = f'starts_beside_registers: {share_beside}; must be 0'
    if not share_beside:
      return
    if not self._used:
      raise errors.SpecError(f'{refusal} if no register stands at a station')
    if not self._layout.are_before_the_barrier(np.array(self._used)).all():
      raise errors.SpecError(
          f'{refusal} where a barrier stands before the registers'
      )

  def initialize_episode(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Changes the start of some episodes."""
    distance, share_ahead = self._schedule.at(self._task.training_step)
    draw = random_state.uniform()
    if draw < self._share_beside:
      self._start_beside(physics, random_state)
    elif draw < self._share_beside + share_ahead:
      self._task.start_ahead(physics, random_state, distance)
      # Blocks of registers may be those of the world.
      for register in self._registers:
        register.settle(physics)
        register.start(physics)

  def _start_beside(
      self, physics: protocols.Physics, random_state: np.random.RandomState
  ) -> None:
    """Moves the avatar beside a register, unless all tries are taken."""
    station = np.array(self._used[random_state.randint(len(self._used))])
    tries = station + random_state.uniform(-_BESIDE, _BESIDE, (_TRIES, 2))
    is_free = np.array(
        [self._arena.is_clear(point, _CLEARANCE) for point in tries]
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
      avatar = self._task.avatar
      avatar.place(physics, tries[is_free.argmax()], avatar.angle(physics))


def checked_share(name: str, share: Any) -> float:
  """Returns a share of episodes.

  Args:
    name: Name of the argument, for the message.
    share: Its value.

  Raises:
    SpecError: If it is not a number from 0 to 1.
  """
  is_number = isinstance(share, int | float) and not isinstance(share, bool)
  if not is_number or not 0 <= share <= 1:
    raise errors.SpecError(
        f'{name}: {share!r:.80}; must be a number from 0 to 1'
    )
  return float(share)


def checked_schedule(points: Any) -> Schedule:
  """Returns a schedule.

  Args:
    points: Its points, `[step, distance, share]` each; `None` for no starts on
      the way.

  Raises:
    SpecError: If they are no numbers in their ranges, in the order of steps.
  """
  if points is None:
    return Schedule()
  try:
    rows = np.array(points, float).reshape(-1, 3)
    steps, fractions = rows[:, 0], rows[:, 1:]
    is_valid = len(rows) == len(points) > 0 and (np.diff(steps) > 0).all()
    is_valid &= np.isfinite(steps).all() and steps[0] >= 0
    is_valid &= ((fractions >= 0) & (fractions <= 1)).all()
    numbers = [number for point in points for number in point]
    is_valid &= all(
        isinstance(number, int | float) and not isinstance(number, bool)
        for number in numbers
    )
  except (TypeError, ValueError, IndexError):
    is_valid = False
  if not is_valid:
    raise errors.SpecError(
        f'starts_on_the_way: {points!r:.80}; must be a list of [step, distance,'
        ' share] with increasing steps from 0, and distances and shares from 0'
        ' to 1'
    )
  return Schedule(tuple(map(tuple, rows.tolist())))


def bring(
    task: base.Task,
    physics: protocols.Physics,
    random_state: np.random.RandomState,
    crate: crates.Crate,
    position: np.ndarray,
    goal: np.ndarray,
) -> None:
  """Puts a crate on the way to a goal: in a third of the cases in the hand.

  In another third, the avatar stands behind the crate and faces the goal. A
  pose of the avatar that is not free is left out.

  Args:
    task: Task with the crate and an avatar, which has been placed.
    physics: Physics of one world.
    random_state: Random generator of the episode.
    crate: The crate.
    position: Where to put it, `(x, y)`, in m.
    goal: Where it belongs, `(x, y)`, in m.
  """
  crate.put(physics, position)
  gap = np.subtract(goal, position)
  heading = np.arctan2(gap[1], gap[0]) + random_state.uniform(-0.6, 0.6)
  case = random_state.randint(3)
  back = (avatars.HAND_DISTANCE, random_state.uniform(0.6, 1.2), None)[case]
  if back is None:
    return
  place = position - back * np.array([np.cos(heading), np.sin(heading)])
  if task.root_entity.room.contains(place.tolist(), _CLEARANCE):
    task.avatar.place(physics, place, heading)
    if case == 0:
      crate.block.grasps[0].hold(physics)

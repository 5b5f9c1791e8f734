"""Places of registers in worlds that differ from episode to episode.

Arenas such as mazes are generated anew, and walkers and targets are put
somewhere else. Where a register would then be inside something, it is moved to
the nearest clear place. Nothing is drawn at random, and nothing but registers
moves, so the episodes of the task stay what they are.
"""

import itertools
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import clearance
from realab_suite.entities import registers
from realab_suite.entities import rotations
from realab_suite.feedback import mechanisms

# Largest distance along each axis by which a register is moved, in m.
_FARTHEST = 10.0
# Distance that a register that was moved has from everything else, in m.
_CLEARANCE = 0.01


@final
class _Blocks(NamedTuple):
  """Blocks of a register, as it stands at the start of an episode.

  Attributes:
    start: Each block, where the episode begins with it.
    reach: The blocks all along their path.
  """

  start: clearance.Shapes
  reach: clearance.Shapes

  @property
  def corners(self) -> np.ndarray:
    """Corners under all blocks for all values, `(4, 3)`, in m."""
    low, high = self.reach.bounds
    least, most = low.min(axis=0), high.max(axis=0)
    sides = itertools.product(*zip(least[:2], most[:2], strict=True))
    return np.array([(*side, least[2]) for side in sides])

  def moved(self, shift: Any, margin: float = 0.0) -> '_Blocks':
    """Returns the blocks, with a margin in m, `(3,)`, in m from this place."""
    return _Blocks(
        *(
            shapes._replace(
                centres=shapes.centres + shift,
                halves=shapes.halves + np.array([margin, margin, 0.0]),
            )
            for shapes in self
        )
    )


def place(
    physics: mjcf.Physics, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Moves registers whose places are not clear to the nearest clear ones.

  A place is clear if the register is on ground, if none of its blocks
  can be inside an immovable object or another register, whatever value is
  written, and if none of them begins inside a movable body. Registers keep
  their angle and height.

  Args:
    physics: Physics of a foreign task that has initialized an episode.
    mechanism: Registers, meters and providers.

  Raises:
    EpisodeInitializationError: If there is no clear place for a register.
  """
  if not mechanism.registers:
    return
  mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
  surveyed = clearance.survey(physics, mechanism.registers)
  world = _World(physics, surveyed)
  blocks = {
      name: _Blocks(start, surveyed.paths[name])
      for name, start in surveyed.starts.items()
  }
  # A register in a clear place does not make way for another one.
  blocked = []
  for name, each in blocks.items():
    if world.is_clear(each):
      world.occupy(each)
    else:
      blocked.append(name)
  shifts = dict.fromkeys(blocks, np.zeros(3))
  for name in blocked:
    shift = world.nearest_clear_place(blocks[name])
    if shift is None:
      x, y, _ = blocks[name].start.centres[0]
      raise composer.EpisodeInitializationError(
          f'design {mechanism.design.name!r}: register {name!r} has no clear'
          f' place within {_FARTHEST:g} m of ({x:.3g}, {y:.3g}); place it'
          ' where there is more room, or reduce its range, scale or block_size'
      )
    world.occupy(blocks[name].moved(shift))
    shifts[name] = shift
  for name, shift in shifts.items():
    _move(physics, mechanism.registers[name], shift)


def _move(
    physics: mjcf.Physics, register: registers.Register, shift: np.ndarray
) -> None:
  """Moves a register in the plane of the floor, `(3,)`, in m."""
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  rotation = rotations.matrices(physics.model.body_quat[frame.element_id])
  displacement = (shift @ rotation)[:2]
  if shift.any():
    register.move(physics, displacement)
    register.start(physics)
  for block in register.blocks:
    block.surroundings.shift(displacement)


@final
class _World:
  """Everything solid in a world, except the registers that are to be placed."""

  def __init__(self, physics: mjcf.Physics, surveyed: clearance.Survey) -> None:
    """Collects the geoms of a world."""
    self._space = space = surveyed.space
    self._fixed = surveyed.select(surveyed.others(space.is_fixed))
    self._movable = surveyed.select(surveyed.others(~space.is_fixed))
    # What registers may stand on.
    self._is_plane = space.is_plane[self._fixed.geoms]
    tops = self._fixed.bounds[1][:, 2]
    self._tops = np.where(self._is_plane, self._fixed.centres[:, 2], tops)
    size = physics.model.geom_size[self._fixed.geoms]
    # A plane without a size has no end.
    is_ended = self._is_plane[:, np.newaxis] & (size > 0.0)
    halves = np.where(is_ended, size, self._fixed.halves)
    self._carriers = self._fixed._replace(halves=halves).bounds

  def occupy(self, blocks: _Blocks) -> None:
    """Adds the blocks of a register as obstacles."""
    self._fixed = clearance.joined([self._fixed, blocks.reach])

  def is_clear(self, blocks: _Blocks) -> bool:
    """Returns True if a register can stay where it is. Planes are endless."""
    is_below = self._is_below(blocks)
    is_on_ground = (
        not is_below.any()
        or bool((is_below & self._is_plane).any())
        or self._is_carried(blocks.corners)
    )
    return is_on_ground and self._is_free(blocks)

  def nearest_clear_place(self, blocks: _Blocks) -> np.ndarray | None:
    """Returns the shift to the nearest clear place, `(3,)`, in m, or `None`."""
    step = float(blocks.start.halves.min())
    along = step * np.arange(-(_FARTHEST // step), _FARTHEST // step + 1)
    shifts = np.stack(np.meshgrid(along, along, 0.0), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(shifts, axis=1).round(6)
    shifts = shifts[np.lexsort((*shifts.T, distance))]
    needs_ground, corners = self._is_below(blocks).any(), blocks.corners
    if needs_ground:
      low, high = (bound[:, :2] for bound in self._carriers)
      shifts_in_plane = shifts[:, np.newaxis, :2]
      is_within = corners[0, :2] + shifts_in_plane >= low
      is_within &= corners[-1, :2] + shifts_in_plane <= high
      shifts = shifts[is_within.all(axis=-1).any(axis=-1)]
    for shift in shifts:
      if needs_ground and not self._is_carried(corners + shift):
        continue
      if self._is_free(blocks.moved(shift, _CLEARANCE)):
        return shift
    return None

  def _is_below(self, blocks: _Blocks) -> np.ndarray:
    """Returns True for fixed geoms whose top is where a register stands.

    Surfaces above the floor are checked when a task is embedded.
    """
    bottom = blocks.corners[0, 2]
    is_below = np.abs(self._tops - bottom) <= clearance.GAP
    return is_below & (bottom <= clearance.GAP)

  def _is_carried(self, corners: np.ndarray) -> bool:
    """Returns True if one geom is under all corners of a register."""
    above = corners + np.array([0.0, 0.0, clearance.GAP])
    return self._space.uncarried(above, 2 * clearance.GAP) is None

  def _is_free(self, blocks: _Blocks) -> bool:
    """Returns True if no block can be inside something."""
    return not (
        any(self._space.meetings(blocks.reach, self._fixed))
        or any(self._space.meetings(blocks.start, self._movable))
    )

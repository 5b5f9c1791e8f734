"""Places of registers in worlds that differ from episode to episode.

Arenas such as mazes are generated anew, and walkers and targets are put
somewhere else. Where a register would then be inside something, it is moved to
the nearest clear place. Nothing is drawn at random, and nothing but registers
moves, so the episodes of the task stay what they are.
"""

from collections.abc import Iterator
import contextlib
import copy
import itertools
from typing import NamedTuple, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import solids
from realab_suite.entities import registers
from realab_suite.entities import surroundings
from realab_suite.feedback import mechanisms

# Largest distance along each axis by which a register is moved, in m.
_FARTHEST = 10.0
# Distance that a register that was moved has from everything else, in m.
_CLEARANCE = 0.01
# Number of places that are checked at once.
_CHUNK = 4096
_PLANE = mujoco.mjtGeom.mjGEOM_PLANE


@final
class _Blocks(NamedTuple):
  """Blocks of a register, as it stands at the start of an episode.

  Attributes:
    starts: Each block, where the episode begins with it.
    reach: All poses of each block, for all values, and lines of sight.
  """

  starts: list[solids.Solid]
  reach: list[solids.Solid]

  @property
  def corners(self) -> np.ndarray:
    """Corners under all blocks for all values, `(4, 3)`, in m."""
    blocks = (s for s in self.reach if s.half.min() > solids.SIGHT)
    bounds = np.array([solid.bounds for solid in blocks])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    sides = itertools.product(*zip(low[:2], high[:2], strict=True))
    return np.array([(*side, low[2]) for side in sides])

  def moved(self, shift: np.ndarray) -> '_Blocks':
    """Returns the blocks, with a margin, `(3,)`, in m from this place."""
    margin = np.array([_CLEARANCE, _CLEARANCE, 0.0])
    starts, reach = (
        [s.moved(shift)._replace(half=s.half + margin) for s in found]
        for found in self
    )
    return _Blocks(starts, reach)


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
  with _unchanged(physics):
    mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
    world = _World(physics, mechanism)
    blocks = {
        name: _find_blocks(physics, register)
        for name, register in mechanism.registers.items()
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
      x, y, _ = blocks[name].starts[0].centre
      raise composer.EpisodeInitializationError(
          f'design {mechanism.design.name!r}: register {name!r} has no clear'
          f' place within {_FARTHEST:g} m of ({x:.3g}, {y:.3g}); place it'
          ' where there is more room, or reduce its range, scale or block_size'
      )
    world.occupy(blocks[name].moved(shift))
    shifts[name] = shift
  for name, register in mechanism.registers.items():
    _move(physics, register, shifts[name])


def _move(
    physics: mjcf.Physics, register: registers.Register, shift: np.ndarray
) -> None:
  """Moves a register in the plane of the floor, `(3,)`, in m."""
  frame = physics.bind(mjcf.get_attachment_frame(register.mjcf_model))
  rotation = surroundings.matrix(physics.model.body_quat[frame.element_id])
  displacement = (shift @ rotation)[:2]
  if shift.any():
    register.settle(physics, displacement)
  for block in register.blocks:
    block.surroundings.shift(displacement)


@contextlib.contextmanager
def _unchanged(physics: mjcf.Physics) -> Iterator[None]:
  """Returns a context after which the state is what it was."""
  saved = copy.copy(physics.data.ptr)
  is_dirty = physics.is_dirty
  try:
    yield
  finally:
    mujoco.mj_copyData(physics.data.ptr, physics.model.ptr, saved)
    if is_dirty:
      physics.mark_as_dirty()


def _find_blocks(
    physics: mjcf.Physics, register: registers.Register
) -> _Blocks:
  """Returns where the blocks of a register are, and can be written to.

  Args:
    physics: Physics; its state is changed.
    register: The register.
  """
  still = np.zeros(2)
  starts = solids.initial_regions(physics, register, still)
  reach = solids.regions(physics, register, still)
  return _Blocks([r.solid for r in starts], [r.solid for r in reach])


@final
class _World:
  """Everything solid in a world, except the registers that are to be placed."""

  def __init__(
      self, physics: mjcf.Physics, mechanism: mechanisms.FeedbackMechanism
  ) -> None:
    """Collects the geoms of a physics in its present state."""
    model = physics.model
    self._space = space = solids.Space(model.ptr)
    is_other = np.ones_like(space.is_fixed)
    is_other[list(solids.owners(physics, mechanism.registers))] = False
    fixed = space.solids(physics, is_other & space.is_fixed)
    movable = space.solids(physics, is_other & ~space.is_fixed)
    self._fixed = solids.Crowd(space, fixed)
    self._movable = solids.Crowd(space, movable)
    is_plane = [model.geom_type[solid.geom] == _PLANE for solid in fixed]
    self._is_plane = np.array(is_plane, bool)
    tops = [solid.bounds[1, 2] for solid in fixed]
    heights = [solid.centre[2] for solid in fixed]
    self._tops = np.where(is_plane, heights, tops)

  def occupy(self, blocks: _Blocks) -> None:
    """Adds the blocks of a register as obstacles."""
    self._fixed = self._fixed.joined(blocks.reach)

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
    step = float(blocks.starts[0].half.min())
    along = step * np.arange(-(_FARTHEST // step), _FARTHEST // step + 1)
    shifts = np.stack(np.meshgrid(along, along, 0.0), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(shifts, axis=1).round(6)
    needs_ground, corners = self._is_below(blocks).any(), blocks.corners
    shifts = shifts[np.lexsort((*shifts.T, distance))]
    with_margin = blocks.moved(np.zeros(3))
    for i in range(0, len(shifts), _CHUNK):
      some = shifts[i : i + _CHUNK]
      # Most places are excluded for many at once.
      if needs_ground:
        some = some[self._space.may_carry(corners, some)]
      for each in with_margin.reach:
        some = some[~self._fixed.is_surely_met(each, some)]
      for each in with_margin.starts:
        some = some[~self._movable.is_surely_met(each, some)]
      for shift in some:
        if needs_ground and not self._is_carried(corners + shift):
          continue
        if self._is_free(blocks.moved(shift)):
          return shift
    return None

  def _is_below(self, blocks: _Blocks) -> np.ndarray:
    """Returns True for fixed geoms whose top is where a register stands.

    Surfaces above the floor are checked when a task is embedded.
    """
    bottom = blocks.corners[0, 2]
    is_below = np.abs(self._tops - bottom) <= solids.GAP
    return is_below & (bottom <= solids.GAP)

  def _is_carried(self, corners: np.ndarray) -> bool:
    """Returns True if one geom is under all corners of a register."""
    above = corners + np.array([0.0, 0.0, solids.GAP])
    return self._space.uncarried(above, 2 * solids.GAP) is None

  def _is_free(self, blocks: _Blocks) -> bool:
    """Returns True if no block can be inside something."""
    return not (
        any(self._fixed.meeting(solid) for solid in blocks.reach)
        or any(self._movable.meeting(solid) for solid in blocks.starts)
    )

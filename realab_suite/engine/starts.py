"""Checks that nothing is put into a register when an episode begins.

A task may move walls and other parts at the start of an episode, and put bodies
somewhere. `placement` has checked the registers against the compiled model.
"""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.engine import solids
from realab_suite.entities import moving
from realab_suite.entities import rotations
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base


def movable_geoms(
    physics: mjcf.Physics,
    task: base.Task,
    mechanism: mechanisms.FeedbackMechanism,
) -> tuple[mjcf.Element, ...]:
  """Returns the solid geoms of bodies that can be pushed.

  Those of the avatar and of registers are not among them.

  Args:
    physics: Physics of one world.
    task: Task of this package.
    mechanism: Registers, meters and providers.
  """
  model = physics.model
  avatar = int(physics.bind(task.avatar.body).element_id)
  own = {
      int(physics.bind(block.geom).element_id)
      for register in mechanism.registers.values()
      for block in register.blocks
  }
  carriers = model.body_weldid[model.geom_bodyid]
  is_movable = (carriers != 0) & (model.body_mocapid[carriers] < 0)
  is_movable &= (model.geom_contype | model.geom_conaffinity) != 0
  is_movable &= (
      model.body_rootid[model.geom_bodyid] != model.body_rootid[avatar]
  )
  return tuple(
      geom
      for geom in task.root_entity.mjcf_model.find_all('geom')
      if (number := int(physics.bind(geom).element_id)) not in own
      and is_movable[number]
  )


@final
class StartCheck:
  """Check of the start of an episode, for one world or a world of a batch.

  It costs next to nothing in worlds where all parts are where the compiled
  model has them.
  """

  def __init__(
      self,
      physics: mjcf.Physics,
      task: base.Task,
      mechanism: mechanisms.FeedbackMechanism,
  ) -> None:
    """Finds the parts that the task can move.

    Args:
      physics: Physics of one world, whose state is reset.
      task: Task of this package, with `mechanism` attached.
      mechanism: Registers, meters and providers.
    """
    self._design = mechanism.design.name
    self._registers = mechanism.registers
    self._model = physics.model.ptr
    self._space: solids.Space | None = None
    self._bodies = movable_geoms(physics, task, mechanism)
    self._parts = _movable_parts(physics, task, mechanism)
    if not self._registers or not (self._parts or self._bodies):
      return
    solids.settle(physics, self._registers.values())
    self._homes = {
        name: np.array(register.blocks[0].position(physics))
        for name, register in self._registers.items()
    }
    self._regions = {
        name: solids.regions(physics, register, np.zeros(2))
        for name, register in self._registers.items()
    }
    physics.reset()

  def __call__(self, physics: Any) -> None:
    """Checks an episode that has just been initialized.

    Args:
      physics: Physics of one world.

    Raises:
      EpisodeInitializationError: If something is inside a register. The next
        attempt may draw other positions.
    """
    if not self._registers or not (self._parts or self._bodies):
      return
    moved = [part for part in self._parts if part.has_moved(physics)]
    if not (moved or self._bodies):
      return
    if self._space is None:
      self._space = solids.Space(self._model)
    space = self._space
    for name, register in self._registers.items():
      home = self._homes[name]
      shift = register.blocks[0].position(physics) - home
      regions = [region.moved(shift) for region in self._regions[name]]
      for part in moved:
        for solid in part.solids(physics, space):
          self._refuse(space, name, regions, solid, part.way)
      if self._bodies:
        regions = solids.initial_regions(physics, register, np.zeros(2))
        for geom in self._bodies:
          solid = space.posed(physics, geom)
          self._refuse(space, name, regions, solid)

  def _refuse(
      self,
      space: solids.Space,
      name: str,
      regions: Sequence[solids.Region],
      obstacle: solids.Solid,
      way: np.ndarray | None = None,
  ) -> None:
    """Raises an error if an obstacle is in one of the regions of a register."""
    bounds = space.bounds(obstacle, way)
    for region in regions:
      low, high = space.bounds(region.hulls[0])
      if (low > bounds[1]).any() or (bounds[0] > high).any():
        continue
      point = space.meet(region.hulls, [obstacle], way)
      if point is not None:
        raise composer.EpisodeInitializationError(
            f'design {self._design!r}:'
            f' {space.describe(name, region, point, obstacle)} when the episode'
            ' begins; allowed are places that the task keeps clear; place the'
            ' register elsewhere, narrow its range, or keep the other away'
        )


@final
class _Part:
  """A solid moving part."""

  def __init__(
      self, physics: mjcf.Physics, part: moving.MovingPart, geoms: list[Any]
  ) -> None:
    """Measures the part where the compiled model has it.

    Args:
      physics: Physics of one world that has just been reset.
      part: The part, attached to a root entity.
      geoms: Its solid geoms.
    """
    self.way = part.travel
    self._frame = part.frame
    bound = physics.bind(part.frame)
    self._position = np.array(bound.mocap_pos)
    self._quaternion = np.array(bound.mocap_quat)
    matrix = rotations.matrices(self._quaternion)
    self._geoms = []
    for geom in geoms:
      pose = physics.bind(geom)
      centre = (np.array(pose.xpos) - self._position) @ matrix
      turn = matrix.T @ np.reshape(pose.xmat, (3, 3))
      self._geoms.append((int(pose.element_id), centre, turn))

  def has_moved(self, physics: Any) -> bool:
    """Returns True if the part is not where the compiled model has it."""
    bound = physics.bind(self._frame)
    # A comparison of bytes takes a fifth of the time of one of arrays.
    return (
        bound.mocap_pos.tobytes() != self._position.tobytes()
        or bound.mocap_quat.tobytes() != self._quaternion.tobytes()
    )

  def solids(self, physics: Any, space: solids.Space) -> list[solids.Solid]:
    """Returns the geoms in their present poses."""
    bound = physics.bind(self._frame)
    matrix = rotations.matrices(np.asarray(bound.mocap_quat))
    return [
        space.solid(geom, bound.mocap_pos + matrix @ centre, matrix @ turn)
        for geom, centre, turn in self._geoms
    ]


def _movable_parts(
    physics: mjcf.Physics,
    task: base.Task,
    mechanism: mechanisms.FeedbackMechanism,
) -> list[_Part]:
  """Returns the solid moving parts of a task, without blocks of registers."""
  model = physics.model
  is_solid = (model.geom_contype | model.geom_conaffinity) != 0
  blocks = [
      block.body
      for register in mechanism.registers.values()
      for block in register.blocks
  ]
  found = []
  for part in task.root_entity.iter_entities():
    if not isinstance(part, moving.MovingPart) or part.frame in blocks:
      continue
    geoms = [
        geom
        for geom in part.mjcf_model.find_all('geom')
        if is_solid[physics.bind(geom).element_id]
    ]
    if geoms and part.frame is not None:
      found.append(_Part(physics, part, geoms))
  return found

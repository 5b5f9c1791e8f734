"""Checks that nothing is put into a register when an episode begins.

A task may move walls and other parts at the start of an episode, and put bodies
somewhere. `placement` has checked the registers against the compiled model.
"""

from collections.abc import Iterator, Sequence
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
    space: solids.Space,
) -> np.ndarray:
  """Returns True for geoms of bodies that can be pushed, `(geoms,)` bool.

  Those of the avatar and of registers are not among them.

  Args:
    physics: Physics of one world.
    task: Task of this package.
    mechanism: Registers, meters and providers.
    space: Space of the model.
  """
  model = physics.model
  roots = model.body_rootid[model.geom_bodyid]
  avatar = int(physics.bind(task.avatar.body).element_id)
  is_movable = ~space.is_fixed & (roots != model.body_rootid[avatar])
  is_movable[list(solids.owners(physics, mechanism.registers))] = False
  return is_movable


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
    self._space = space = solids.Space(physics.model.ptr)
    movable = movable_geoms(physics, task, mechanism, space)
    bodies = {solid.geom for solid in space.solids(physics, movable)}
    self._bodies = tuple(
        geom
        for geom in task.root_entity.mjcf_model.find_all('geom')
        if bodies and physics.bind(geom).element_id in bodies
    )
    # Solid geoms of moving parts, with the mocap body and the way of each.
    own = solids.owners(physics, mechanism.registers)
    parts = [
        (solid, part.frame, part.travel)
        for part in task.root_entity.iter_entities()
        if isinstance(part, moving.MovingPart)
        for solid in space.solids_of(physics, part.mjcf_model)
        if solid.geom not in own
    ]
    self._parts = [(solid, way) for solid, _, way in parts]
    self._frames = tuple(frame for _, frame, _ in parts)
    self._homes = self._poses(physics)
    self._registers = mechanism.registers if parts or self._bodies else {}
    if not self._registers:
      return
    solids.settle(physics, self._registers.values())
    self._regions = {
        name: (
            np.array(register.blocks[0].position(physics)),
            solids.regions(physics, register, np.zeros(2)),
        )
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
    if not self._registers:
      return
    if parts := list(self._moved_parts(physics)):
      crowd = solids.Crowd(self._space, parts)
      for name, (home, regions) in self._regions.items():
        shift = self._registers[name].blocks[0].position(physics) - home
        self._refuse(name, [region.moved(shift) for region in regions], crowd)
    if self._bodies:
      bound = physics.bind(self._bodies)
      poses = zip(bound.element_id, bound.xpos, bound.xmat, strict=True)
      crowd = solids.Crowd(
          self._space, [self._space.solid(*pose) for pose in poses]
      )
      for name, register in self._registers.items():
        still = np.zeros(2)
        regions = solids.initial_regions(physics, register, still)
        self._refuse(name, regions, crowd)

  def _moved_parts(self, physics: Any) -> Iterator[solids.Solid]:
    """Yields the geoms of parts that the task has moved, along their ways."""
    poses = self._poses(physics)
    for i in np.flatnonzero((poses != self._homes).any(axis=1)).tolist():
      old, new = self._homes[i], poses[i]
      turn = rotations.matrices(new[3:]) @ rotations.matrices(old[3:]).T
      solid, way = self._parts[i]
      centre = new[:3] + turn @ (solid.centre - old[:3])
      yield solid._replace(centre=centre, matrix=turn @ solid.matrix, way=way)

  def _poses(self, physics: Any) -> np.ndarray:
    """Returns the poses of the mocap body of each geom, `(geoms, 7)`."""
    if not self._frames:
      return np.zeros((0, 7))
    bound = physics.bind(self._frames)
    return np.concatenate([bound.mocap_pos, bound.mocap_quat], axis=1)

  def _refuse(
      self, name: str, regions: Sequence[solids.Region], crowd: solids.Crowd
  ) -> None:
    """Raises an error if one of some solids is in a region of a register."""
    for region in regions:
      if (found := crowd.meeting(region.solid)) is not None:
        obstacle, point = found
        raise composer.EpisodeInitializationError(
            f'design {self._design!r}: register {name!r}'
            f' {region.describe(point)}, inside'
            f' {self._space.name(obstacle.geom)!r} when the episode begins;'
            ' allowed are places that the task keeps clear; place the register'
            ' elsewhere, narrow its range, or keep the other away'
        )

"""A mechanism in a task of either kind, before it is compiled."""

from collections.abc import Callable, Mapping
from typing import Any

from dm_control import composer

from realab_suite import errors
from realab_suite.entities import avatars
from realab_suite.entities import block_kinds
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base


def connect_meters(
    task: composer.Task,
    mechanism: mechanisms.FeedbackMechanism,
    added: Mapping[str, Callable[[Any], Any]],
) -> None:
  """Connects the meters of a mechanism to a task.

  Meters of a foreign task can measure all parts and bodies of the world, and
  no functions of the task.

  Args:
    task: Task with the mechanism.
    mechanism: Registers, meters and providers.
    added: Functions of the physics that meters can measure as well, by name.

  Raises:
    SpecError: If a meter measures what this world does not offer, or if an
      added measurement has the name of another one.
  """
  functions: dict[str, Any] = {'score': mechanism.score}
  parts = ranges = None
  if isinstance(task, base.Task):
    functions |= task.measurements
    parts, ranges = task.measurables, task.measured_ranges
  for name in added:
    if name in functions:
      raise errors.SpecError(
          f'measurements: {name!r} is measured by the task; must be a name'
          f' other than {sorted(functions)}'
      )
  privileged = getattr(task, 'privileged_senses', {})
  mechanism.connect({**functions, **added}, parts, privileged, ranges)


def add_registers(
    task: composer.Task, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Adds registers that have been attached to the task's root entity.

  The avatars of this package can then grasp their blocks. The environment
  designer decides on the physics of a world. If the blocks of a design changed
  the substeps, designs would not be compared in the same world.

  Args:
    task: Task with the registers.
    mechanism: Registers, meters and providers.

  Raises:
    SpecError: If the substeps are too long for a block, or if the task does
      not allow the registers.
  """
  if isinstance(task, base.Task):
    for name, register in mechanism.registers.items():
      for block in register.blocks:
        _refuse_misfit(name, block, task.physics_timestep)
    task.add_registers([*mechanism.registers.values()])
    return
  for avatar in _avatars_in(task):
    avatar.make_graspable(_blocks_of(mechanism))


def remove_registers(
    task: composer.Task, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Undoes `add_registers`."""
  if isinstance(task, base.Task):
    task.remove_registers([*mechanism.registers.values()])
    return
  for avatar in _avatars_in(task):
    avatar.forget(_blocks_of(mechanism))


def _avatars_in(task: composer.Task) -> list[avatars.Avatar]:
  return [
      entity
      for entity in task.root_entity.iter_entities()
      if isinstance(entity, avatars.Avatar)
  ]


def _blocks_of(mechanism: mechanisms.FeedbackMechanism) -> list[Any]:
  return [b for r in mechanism.registers.values() for b in r.own_blocks]


def _refuse_misfit(
    name: str, block: block_kinds.Block, physics_timestep: float
) -> None:
  """Raises a SpecError if the substeps of a task are too long for a block."""
  misfit = block_kinds.find_misfit(block, physics_timestep)
  if misfit is not None:
    remedy = {'physics_timestep': block_kinds.SHORT_SUBSTEP}
    raise errors.SpecError(
        f'register {name!r}: {misfit.given}; the substeps of'
        f' {1000 * physics_timestep:g} ms of the task {misfit.effect}; must'
        f' be {misfit.allowed}, or others if the task takes short substeps:'
        f' task_kwargs={remedy}'
    )

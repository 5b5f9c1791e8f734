"""Registers, their places, and the world that they are assembled in."""

from collections.abc import Mapping
from typing import Any

from dm_control import composer

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import arenas
from realab_suite.entities import measurables
from realab_suite.entities.registers import base
from realab_suite.feedback import specs


def make_register(
    name: str, spec: specs.RegisterSpec, design: specs.DesignSpec
) -> base.Register:
  """Makes a register of a design.

  Args:
    name: Name of the register.
    spec: Its spec.
    design: Design that contains the register.

  Raises:
    SpecError: If the register kind refuses its arguments.
  """
  arguments = spec.model_copy(
      update={
          'channel': design.channel_of(name),
          'dof': spec.dof or design.dof,
      }
  )
  location = messages.Location(f'design {design.name!r}', ('registers', name))
  try:
    return spec.register_class(name, arguments=arguments, **spec.options)
  except errors.SpecError as error:
    raise location.error(str(error)) from error
  except Exception as error:  # Register kinds may raise any class.
    raise location.error(messages.exception(error)) from error


def find_place(
    name: str,
    place: str | specs.PlaceSpec | None,
    named_places: Mapping[str, arenas.Place],
) -> arenas.Place:
  """Returns the place of a register.

  Args:
    name: Name of the register, for messages.
    place: Name of a place, or coordinates; `None` without blocks.
    named_places: Places of the world, by name.

  Raises:
    SpecError: If the world has no place of this name.
  """
  if place is None:
    return arenas.Place((0.0, 0.0))
  if isinstance(place, specs.PlaceSpec):
    x, y, height = (*place.position, 0.0)[:3]
    return arenas.Place((x, y), place.yaw, place.spread, height)
  if place not in named_places:
    raise errors.SpecError(
        f'registers.{name}.place: this world has no place {place!r}'
        f'{messages.did_you_mean(place, named_places)}; must be'
        f' one of {sorted(named_places)} or coordinates'
    )
  return named_places[place]


def attach(
    register: base.Register, root: composer.Entity, place: arenas.Place
) -> None:
  """Attaches a register to the root entity of a task, or to a mechanism."""
  position = (*place.position, place.height)
  register.attach_to(root, position, place.yaw, place.spread)
  if place.block is not None:
    register.borrow(root, place.block)


def parts_beside(mechanism: Any) -> dict[str, measurables.Measurable]:
  """Returns the parts of a world that meters can measure, by name.

  They are those that entities declare, and all bodies. Blocks of registers are
  left out, because they are measured by the names of their registers.

  Args:
    mechanism: The `FeedbackMechanism`, attached to the world.
  """
  root = mechanism
  while root.parent is not None:
    root = root.parent
  parts = {**measurables.bodies_in_world(root), **measurables.in_world(root)}
  blocks = [
      block.body
      for register in mechanism.registers.values()
      for block in register.blocks
  ]
  return {
      name: part
      for name, part in parts.items()
      if not any(one is body for one in blocks for body in part.bodies)
  }

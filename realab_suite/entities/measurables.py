"""Parts of a world that meters can measure, and their true state.

Entities declare parts: bodies, and the number of those that were collected. The
name of a part is that of the entity's model, as in `avatar`, `pad`, `apples`.
"""

import abc
from collections.abc import Callable
import dataclasses
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite.entities import modelled
from realab_suite.entities import protocols

_WITHOUT_DISTANCES = ('plane', 'hfield', 'sdf')


@final
@dataclasses.dataclass(frozen=True)
class Measurable:
  """A part of a world that meters can measure.

  Attributes:
    bodies: Bodies of the part. Several bodies are a group, such as apples.
    is_present: Function of the physics that returns True for each body that is
      in the world, `(..., bodies)` bool; `None` if all are, always.
    num_collected: Function of the physics that returns the number of bodies
      collected in this episode, `(...)`; `None` if nothing collects them.
  """

  bodies: tuple[mjcf.Element, ...]
  is_present: Callable[[Any], np.ndarray] | None = None
  num_collected: Callable[[Any], np.ndarray] | None = None

  @property
  def geoms(self) -> tuple[mjcf.Element, ...]:
    """Geoms of the bodies and of their children with surfaces to touch.

    Geoms whose own `contype` and `conaffinity` are 0 collide with nothing.
    MuJoCo computes no distances of planes, height fields and SDFs.
    """
    return tuple(
        geom
        for body in self.bodies
        for geom in body.find_all('geom')
        if geom.type not in _WITHOUT_DISTANCES
        and (geom.contype != 0 or geom.conaffinity != 0)
    )

  def positions(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the positions of the bodies, `(..., bodies, 3)`, in m."""
    return np.array(physics.bind(self.bodies).xpos)


class MeasurableEntity(modelled.ModelledEntity):
  """Base class for entities that meters can measure."""

  @property
  @abc.abstractmethod
  def measurable(self) -> Measurable:
    """Part of the world to measure; complete once the entity is attached."""


def in_world(root: composer.Entity) -> dict[str, Measurable]:
  """Returns the parts that entities declare, by name.

  Args:
    root: Root entity of a task.
  """
  return {
      entity.mjcf_model.model: entity.measurable
      for entity in root.iter_entities()
      if isinstance(entity, MeasurableEntity)
  }


def bodies_in_world(root: composer.Entity) -> dict[str, Measurable]:
  """Returns all bodies with names, by their full MJCF identifiers.

  The body of an attached entity has an identifier such as `walker/`.

  Args:
    root: Root entity of a task.
  """
  elements = root.mjcf_model.find_all('body')
  elements += root.mjcf_model.find_all('attachment_frame')
  return {
      body.full_identifier: Measurable((body,))
      for body in elements
      if body.full_identifier
  }

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
    bodies: Bodies of the part, all with or all without `mocap`. Several bodies
      are a group, such as apples.
    is_present: Function of the physics that returns True for each body that is
      in the world, `(..., bodies)` bool; `None` if all are, always.
    num_collected: Function of the physics that returns the number of bodies
      collected in this episode, `(...)`; `None` if nothing collects them.
  """

  bodies: tuple[mjcf.Element, ...]
  is_present: Callable[[Any], np.ndarray] | None = None
  num_collected: Callable[[Any], np.ndarray] | None = None

  @property
  def is_moved_by_code(self) -> bool:
    """True if nothing can push the bodies, so that they have no velocity."""
    return all(_is_mocap(body) for body in self.bodies)

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

  def speeds(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the speeds of the bodies, `(..., bodies)`, in m/s.

    The speed of a body that code moves is 0.
    """
    return np.stack([_speed(physics, body) for body in self.bodies], axis=-1)


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


def _speed(physics: protocols.Physics, body: mjcf.Element) -> np.ndarray:
  bound = physics.bind(body)
  if _is_mocap(body):
    return np.zeros(np.shape(bound.xpos)[:-1])
  # MuJoCo's velocity of a body is that of the point of the body at the centre
  # of mass of the whole tree that the body belongs to.
  turning, moving = np.split(np.asarray(bound.cvel), 2, axis=-1)
  centre = np.asarray(physics.bind(_root_of(body)).subtree_com)
  velocity = moving + np.cross(turning, np.asarray(bound.xpos) - centre)
  return np.sqrt((velocity * velocity).sum(axis=-1))


def _root_of(body: mjcf.Element) -> mjcf.Element:
  """Returns the child of the world that a body belongs to."""
  while True:
    if body.parent.tag != 'worldbody':
      body = body.parent
    elif body.root.parent_model is not None:
      body = mjcf.get_attachment_frame(body.root)
    else:
      return body


def _is_mocap(body: mjcf.Element) -> bool:
  return getattr(body, 'mocap', None) == 'true'

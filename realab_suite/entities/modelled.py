"""Base class for entities with an MJCF model of their own."""

import abc
from collections.abc import Iterator

from dm_control import composer
from dm_control import mjcf

from realab_suite.entities import state


def entities_beside(entity: composer.Entity) -> list[composer.Entity]:
  """Returns all entities of the world of an entity, which is one of them."""
  while entity.parent is not None:
    entity = entity.parent
  return [*entity.iter_entities()]


class ModelledEntity(composer.Entity, abc.ABC):
  """Base class for entities that build their model in `_mjcf_root`."""

  _mjcf_root: mjcf.RootElement

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  def iter_entities(
      self, exclude_self: bool = False
  ) -> Iterator[composer.Entity]:
    """Yields the entity and those attached to it.

    An environment of Composer calls this method before it compiles a world.
    """
    state.offer_room(self.mjcf_model)
    yield from super().iter_entities(exclude_self)

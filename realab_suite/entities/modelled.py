"""Base class for entities with an MJCF model of their own."""

import abc

from dm_control import composer
from dm_control import mjcf


class ModelledEntity(composer.Entity, abc.ABC):
  """Base class for entities that build their model in `_mjcf_root`."""

  _mjcf_root: mjcf.RootElement

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

"""Many worlds behind the interface of one, for tests of trailing axes.

Entities read `physics.bind(element).attribute` and `physics.data.userdata` by
trailing axes and write whole attributes. Here both are stacked over ordinary
worlds, in the simplest way there is: nothing is shared, so what an entity does
to many worlds at once can be compared with what it does to each of them.
"""

from collections.abc import Sequence
from typing import Any

from dm_control import mjcf
import numpy as np

from realab_suite.entities import rays
from tests import worlds


class FakeBatch:
  """Stacks worlds of one model."""

  def __init__(self, worlds: Sequence[mjcf.Physics]):
    self.worlds = list(worlds)
    self.model = self.worlds[0].model
    self.data = _StackedData(self.worlds)

  def bind(self, elements: Any) -> '_StackedBinding':
    return _StackedBinding([world.bind(elements) for world in self.worlds])

  def step(self, steps: int = 1) -> None:
    self.flush()
    for world in self.worlds:
      worlds.step(world, steps)

  def mark_as_dirty(self) -> None:
    for world in self.worlds:
      world.mark_as_dirty()

  def flush(self) -> None:
    """Copies what is kept for all worlds together into each of them."""
    for world, userdata in zip(self.worlds, self.data.userdata, strict=True):
      world.data.userdata[:] = userdata


class _StackedBinding:
  """Bindings of the same elements, one for each world."""

  def __init__(self, bindings: Sequence[Any]):
    object.__setattr__(self, '_bindings', bindings)

  @property
  def element_id(self) -> Any:
    return self._bindings[0].element_id

  def __getattr__(self, name: str) -> np.ndarray:
    return _stack([getattr(binding, name) for binding in self._bindings])

  def __setattr__(self, name: str, value: Any) -> None:
    value = np.broadcast_to(value, getattr(self, name).shape)
    for binding, part in zip(self._bindings, value, strict=True):
      setattr(binding, name, part)


class _StackedData:
  """The `userdata` of all worlds, of which entities keep live views."""

  def __init__(self, worlds: Sequence[mjcf.Physics]):
    self.userdata = np.stack([world.data.userdata for world in worlds])


def _stack(arrays: Sequence[Any]) -> np.ndarray:
  """Returns a copy that nobody can write to in the belief that it counts."""
  stacked = np.stack([np.asarray(array) for array in arrays])
  stacked.flags.writeable = False
  return stacked


@rays.cast.register
def _(
    physics: FakeBatch,
    origin: np.ndarray,
    directions: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray]:
  cast = rays.cast.dispatch(mjcf.Physics)
  results = [
      cast(world, *where, excluded_body)
      for world, *where in zip(physics.worlds, origin, directions, strict=True)
  ]
  distances, geoms = zip(*results, strict=True)
  return np.stack(distances), np.stack(geoms)

"""Slots of MuJoCo `userdata`, in which entities keep the state of an episode.

Besides poses and velocities, all state of an entity within an episode (such as
the apples eaten, or the start pose of a register) is in slots, never in Python
attributes. One copy of MuJoCo's integration state is therefore a snapshot of
the whole episode, and a batch of worlds can share one entity.
"""

from collections.abc import Iterator, Mapping
import contextlib
import types
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import protocols

# `nuserdata` of every model with a slot. It is the same for all models because
# PyMJCF refuses to merge models with different values.
CAPACITY = 256
_PREFIX = 'userdata.'

# Cached layout of each compiled model, because every slot needs the layout and
# computing it takes a pass over all slots.
_layouts: weakref.WeakKeyDictionary[Any, dict[str, int]] = (
    weakref.WeakKeyDictionary()
)


@final
class Slot:
  """A named part of `userdata`, claimed when an entity is built.

  The claim is an MJCF `numeric` in the model of the entity. The claim stays
  with the entity when it is attached, and the compiled model contains the
  claims of all entities.
  """

  def __init__(
      self, mjcf_model: mjcf.RootElement, name: str, size: int | None = None
  ) -> None:
    """Claims a slot.

    Args:
      mjcf_model: Model of the entity that owns the slot.
      name: Name of the slot, unique in `mjcf_model`.
      size: Number of floats, or `None` for a scalar.
    """
    mjcf_model.size.nuserdata = CAPACITY
    self._numeric = mjcf_model.custom.add(
        'numeric', name=_PREFIX + name, size=size or 1
    )
    self._size = size
    self._model: Any = None
    self._index: int | slice = 0
    self._data: Any = None
    self._view = np.zeros(0)

  def get(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the values, `(..., size)` or `(...)` for a scalar.

    An array is live: it changes with the state. The value of a scalar in one
    world is a number; see `axes`.

    Args:
      physics: One world or a batch of worlds.

    Raises:
      StateLayoutError: If the slot is not in the compiled model.
    """
    if physics.data is not self._data:
      self._resolve(physics)
    return self._view[()]

  def array(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the live array, without axes for a scalar in one world."""
    if physics.data is not self._data:
      self._resolve(physics)
    return self._view

  def copy(self, physics: protocols.Physics) -> np.ndarray:
    """Returns a copy of the values; see `get`."""
    if physics.data is not self._data:
      self._resolve(physics)
    value = self._view[()]
    return value.copy() if value.ndim else value  # A number cannot change.

  def set(
      self, physics: protocols.Physics, value: Any, where: axes.Mask = None
  ) -> None:
    """Stores a value.

    Args:
      physics: One world or a batch of worlds.
      value: Value that broadcasts to the shape that `get` returns.
      where: Worlds in which to store it, `(...)` bool; `None` for all worlds.

    Raises:
      StateLayoutError: If the slot is not in the compiled model.
    """
    if physics.data is not self._data:
      self._resolve(physics)
    if where is not None:
      value = axes.merge(where, value, self._view)
    self._view[...] = value

  def _resolve(self, physics: protocols.Physics) -> None:
    """Finds the slot in the data of a physics and caches the result."""
    model = physics.model
    if model is not self._model:
      start = layout(model).get(self._numeric.full_identifier)
      if start is None:
        raise errors.StateLayoutError(
            f'{self._numeric.full_identifier}: not in the compiled model;'
            ' attach the entity before the physics is compiled'
        )
      end = start + (self._size or 1)
      self._index = start if self._size is None else slice(start, end)
      self._model = model
    self._view = physics.data.userdata[..., self._index]
    self._data = physics.data


@final
class Slots:
  """Several slots of an entity, whose arrays one call returns."""

  def __init__(self, mjcf_model: mjcf.RootElement, **sizes: int | None) -> None:
    """Claims slots, given the size of each by name; see `Slot`."""
    self._slots = {
        name: Slot(mjcf_model, name, size) for name, size in sizes.items()
    }
    self._data: Any = None
    self._arrays = types.SimpleNamespace()

  def of(self, physics: protocols.Physics) -> types.SimpleNamespace:
    """Returns the live array of each slot, as an attribute of its name.

    Index the array of a scalar with `()` to get a number in one world.
    """
    if physics.data is not self._data:
      arrays = {name: slot.array(physics) for name, slot in self._slots.items()}
      self._arrays = types.SimpleNamespace(**arrays)
      self._data = physics.data
    return self._arrays


def make_room(mjcf_model: mjcf.RootElement) -> None:
  """Increases `nuserdata` of a model if its slots need more than `CAPACITY`.

  Worlds that this package loads do not need this function. For other worlds,
  such as a plain `composer.Environment`, call it once after all entities are
  attached, if their slots need more than `CAPACITY` numbers.

  Args:
    mjcf_model: Model of the root entity.
  """
  numerics = mjcf_model.find_all('numeric')
  needed = sum([int(n.size) for n in numerics if n.name.startswith(_PREFIX)])
  if needed > CAPACITY:
    mjcf_model.size.nuserdata = needed


@contextlib.contextmanager
def room_for_slots(mjcf_model: mjcf.RootElement) -> Iterator[None]:
  """Calls `make_room` and restores `nuserdata` at the end of the context.

  Entities can be attached after the context, because `nuserdata` then agrees
  with theirs again.

  Args:
    mjcf_model: Model of the root entity.
  """
  before = mjcf_model.size.nuserdata
  make_room(mjcf_model)
  try:
    yield
  finally:
    mjcf_model.size.nuserdata = before


def layout(model: Any) -> Mapping[str, int]:
  """Returns the first `userdata` index of each slot, by its full name.

  Args:
    model: Compiled model, as `physics.model`.

  Raises:
    StateLayoutError: If the slots need more numbers than the model has.
  """
  if model in _layouts:
    return _layouts[model]
  starts, end = {}, 0
  for i in range(model.nnumeric):
    name = mujoco.mj_id2name(model.ptr, mujoco.mjtObj.mjOBJ_NUMERIC, i)
    if name.rpartition('/')[2].startswith(_PREFIX):
      starts[name] = end
      end += int(model.numeric_size[i])
  if end > model.nuserdata:
    raise errors.StateLayoutError(
        f'{len(starts)} slots need {end} numbers of userdata; the model has'
        f' {model.nuserdata}; call state.make_room before it is compiled'
    )
  return _layouts.setdefault(model, starts)

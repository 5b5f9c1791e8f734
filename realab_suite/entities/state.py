"""Slots of MuJoCo `userdata`, in which entities keep the state of an episode.

Besides poses and velocities, all state of an entity within an episode (such as
the apples eaten, or the start pose of a register) is in slots, never in Python
attributes. One copy of MuJoCo's integration state is therefore a snapshot of
the whole episode, and a batch of worlds can share one entity.
"""

from collections.abc import Iterator, Mapping
import contextlib
import itertools
import types
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import protocols

# Least number of userdata for slots in a model. Models of entities declare
# none, because PyMJCF refuses to merge models with different `nuserdata`.
CAPACITY = 256
_PREFIX = 'userdata.'

# Cached layout of each compiled model, because every slot needs the layout and
# computing it takes a pass over all slots.
_layouts: weakref.WeakKeyDictionary[Any, dict[str, int]] = (
    weakref.WeakKeyDictionary()
)
# `nuserdata` of root models with room: their own, and with room.
_rooms: weakref.WeakKeyDictionary[Any, tuple[int | None, int]] = (
    weakref.WeakKeyDictionary()
)
# Root models for which an environment makes room when it compiles them.
_managed: weakref.WeakSet[Any] = weakref.WeakSet()


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
  """Makes room for slots, after the userdata that the model has itself.

  Environments do not need this function, except those of Composer whose slots
  need more than `CAPACITY` numbers, or with no entity of this package: call it
  once after all entities are attached. Call it as well before a model is
  compiled without an environment.

  Args:
    mjcf_model: Model of an entity in the world.
  """
  root = mjcf_model.root_model
  own = _own_size(root)
  numerics = root.find_all('numeric')
  needed = sum([int(n.size) for n in numerics if n.name.startswith(_PREFIX)])
  if needed:
    root.size.nuserdata = (own or 0) + max(needed, CAPACITY)
    _rooms[root] = own, root.size.nuserdata


def offer_room(mjcf_model: mjcf.RootElement) -> None:
  """Makes room if there is none, and if no environment manages the room.

  Args:
    mjcf_model: Model of an entity in the world.
  """
  root = mjcf_model.root_model
  if root not in _managed and not _has_room(root):
    make_room(root)


def manage_room(mjcf_model: mjcf.RootElement) -> None:
  """Removes the room for slots, which the caller makes for each compilation.

  Models with any `nuserdata` can then be attached and detached in between.

  Args:
    mjcf_model: Model of an entity in the world.
  """
  root = mjcf_model.root_model
  root.size.nuserdata = _own_size(root)
  _rooms.pop(root, None)
  _managed.add(root)


@contextlib.contextmanager
def room_for_slots(mjcf_model: mjcf.RootElement) -> Iterator[None]:
  """Calls `make_room`, and `manage_room` at the end of the context.

  Args:
    mjcf_model: Model of the root entity.
  """
  make_room(mjcf_model)
  try:
    yield
  finally:
    manage_room(mjcf_model)


def _has_room(root: mjcf.RootElement) -> bool:
  return root in _rooms and root.size.nuserdata == _rooms[root][1]


def _own_size(root: mjcf.RootElement) -> int | None:
  """Returns the `nuserdata` of a model without room for slots."""
  return _rooms[root][0] if _has_room(root) else root.size.nuserdata


def layout(model: Any) -> Mapping[str, int]:
  """Returns the first `userdata` index of each slot, by its full name.

  Args:
    model: Compiled model, as `physics.model`.

  Raises:
    StateLayoutError: If the slots need more numbers than the model has.
  """
  if model in _layouts:
    return _layouts[model]
  sizes = {}
  for i in range(model.nnumeric):
    name = mujoco.mj_id2name(model.ptr, mujoco.mjtObj.mjOBJ_NUMERIC, i)
    if name.rpartition('/')[2].startswith(_PREFIX):
      sizes[name] = int(model.numeric_size[i])
  needed = sum(sizes.values())
  first = model.nuserdata - max(needed, CAPACITY)
  if sizes and first < 0:
    raise errors.StateLayoutError(
        f'{len(sizes)} slots need {needed} numbers of userdata; the model has'
        f' {model.nuserdata}; call state.make_room before it is compiled'
    )
  ends = itertools.accumulate(sizes.values(), initial=first)
  return _layouts.setdefault(model, dict(zip(sizes, ends, strict=False)))

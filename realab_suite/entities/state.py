"""Slots of MuJoCo `userdata`: where entities keep the state of an episode.

Poses and velocities are state already. Whatever else an entity has to remember
within an episode (apples eaten, the pose that a register started from) goes
into a slot, never into a Python attribute. So one copy of MuJoCo's integration
state is a snapshot of the whole episode, and many worlds can share one entity.
"""

from collections.abc import Iterator
import contextlib
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.entities import protocols

# Numbers of userdata that every model with a slot asks for. All ask alike
# because PyMJCF merges `nuserdata` of attached models only where they agree.
CAPACITY = 256
_PREFIX = 'userdata.'

# The layout of each compiled model. Every slot needs it, and to find it takes a
# look at all slots.
_layouts: weakref.WeakKeyDictionary[Any, dict[str, int]] = (
    weakref.WeakKeyDictionary()
)


@final
class Slot:
  """A named piece of `userdata`, claimed when an entity is built.

  The claim is an MJCF `numeric` in the entity's own model. It travels with the
  entity into whatever it is attached to, and the compiled model is the record
  of who owns which numbers.
  """

  def __init__(
      self, mjcf_model: mjcf.RootElement, name: str, size: int | None = None
  ) -> None:
    """Claims a slot.

    Args:
      mjcf_model: The model of the entity that owns the slot.
      name: A name that is unique in `mjcf_model`.
      size: How many floats, or `None` for a scalar.
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
    """Returns the values, shape `(..., size)` or `(...)` for a scalar.

    An array is live: it goes on changing with the state. A scalar of one world
    is a number; see `axes`.
    """
    if physics.data is not self._data:
      self._resolve(physics)
    return self._view[()]

  def copy(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the values as they are now, as `get` does."""
    return np.array(self.get(physics))[()]

  def set(self, physics: protocols.Physics, value: Any) -> None:
    """Stores `value`, which broadcasts to the shape that `get` returns."""
    if physics.data is not self._data:
      self._resolve(physics)
    self._view[...] = value

  def _resolve(self, physics: protocols.Physics) -> None:
    """Finds the slot in the state of a world other than the last one."""
    model = physics.model
    if model is not self._model:
      start = _cached_layout(model).get(self._numeric.full_identifier)
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


def make_room(mjcf_model: mjcf.RootElement) -> None:
  """Lets a model have as much userdata as the slots in it need.

  Worlds that this package loads have it. Elsewhere, as in a plain
  `composer.Environment`, worlds have `CAPACITY` numbers; if that is too few,
  call this once, when everything is attached.

  Args:
    mjcf_model: The model of the root entity.
  """
  numerics = mjcf_model.find_all('numeric')
  needed = sum(int(n.size) for n in numerics if n.name.startswith(_PREFIX))
  if needed > CAPACITY:
    mjcf_model.size.nuserdata = needed


@contextlib.contextmanager
def room_for_slots(mjcf_model: mjcf.RootElement) -> Iterator[None]:
  """Does `make_room` for as long as the context lasts.

  Entities that are attached afterwards have to agree with the model.
  """
  before = mjcf_model.size.nuserdata
  make_room(mjcf_model)
  try:
    yield
  finally:
    mjcf_model.size.nuserdata = before


def layout(model: Any) -> dict[str, int]:
  """Maps the full name of every claimed slot to its first `userdata` index.

  Args:
    model: The compiled model, as `physics.model`.

  Raises:
    StateLayoutError: If the claims need more room than the model has.
  """
  return dict(_cached_layout(model))


def _cached_layout(model: Any) -> dict[str, int]:
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

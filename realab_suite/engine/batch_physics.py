"""Many worlds of one model, behind the interface that entities know.

Entities bind elements and read trailing axes, so they do not notice that there
is a leading axis of worlds. Underneath is `mujoco.batch.Batch`, which steps the
worlds on threads. Its state arrays are live; what derives from the state is
brought up to date when it is read.
"""

import abc
from collections.abc import Iterable
import copy
from typing import Any, final

from dm_control import mjcf
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from realab_suite import errors
from realab_suite.engine import single_physics
from realab_suite.entities import cameras
from realab_suite.entities import protocols
from realab_suite.entities import rays

# Positions and velocities, and what derives from them: what `mj_step1` does.
_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)

# The state field that each bound attribute is part of.
_STATE_FIELDS = {
    'qpos': 'qpos',
    'qvel': 'qvel',
    'ctrl': 'ctrl',
    'mocap_pos': 'mocap_pos',
    'mocap_quat': 'mocap_quat',
    'active': 'eq_active',
}
# The derived field of each bound attribute, by the kind of the element.
_DERIVED_FIELDS = {
    ('body', 'xpos'): 'xpos',
    ('mocap_body', 'xpos'): 'xpos',
    ('site', 'xpos'): 'site_xpos',
    ('geom', 'xpos'): 'geom_xpos',
    ('body', 'xmat'): 'xmat',
    ('mocap_body', 'xmat'): 'xmat',
    ('site', 'xmat'): 'site_xmat',
    ('geom', 'xmat'): 'geom_xmat',
}


@final
class BatchPhysics:
  """`num_envs` worlds; every bound array has a leading axis of worlds."""

  def __init__(
      self,
      template: single_physics.ThinPhysics,
      num_envs: int,
      num_threads: int = 0,
      sleep: bool = False,
  ) -> None:
    """Makes worlds of the model of another physics.

    Args:
      template: Knows the model, and where in it an element is. It belongs to
        the worlds from now on: what is drawn of them is drawn by it.
      num_envs: How many worlds.
      num_threads: How many threads step them; 0 for all processors.
      sleep: Whether blocks at rest fall asleep.
    """
    self._template = template
    self._model = template.model
    if sleep:
      # Who may sleep was decided when the model was compiled: all but the
      # avatar, whose motors can move it at any time.
      self._model = copy.copy(template.model)
      self._model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    # Who sleeps is in no part of the state; a batch that is persistent keeps
    # it, in all that MuJoCo has of each world.
    self._batch = mujoco_batch.Batch(
        self._model.ptr, num_envs, num_threads, persistent=sleep
    )
    # Casting rays between the steps of one batch would disturb what it keeps
    # from step to step; another one looks at a copy of the state. There nobody
    # sleeps, so everything is seen where it is.
    self._ray_batch = mujoco_batch.Batch(
        template.model.ptr, num_envs, num_threads
    )
    self._data = _Userdata(self._batch.bind('userdata'))
    self._bindings: dict[Any, _BatchBinding] = {}
    self._is_dirty = True
    self._worlds = [_WorldView(self, i) for i in range(num_envs)]

  @property
  def num_envs(self) -> int:
    """How many worlds there are."""
    return int(self._batch.nsim)

  @property
  def model(self) -> Any:
    """The compiled model, as `mjcf.Physics.model`."""
    return self._model

  @property
  def data(self) -> '_Userdata':
    """Holds `userdata`, `(worlds, slots)`, live."""
    return self._data

  @property
  def state(self) -> np.ndarray:
    """The integration state of every world, `(worlds, size)`, live."""
    return self._batch.state

  def world(self, index: int) -> protocols.Physics:
    """Returns one world, for what is done to one at a time, as at a reset."""
    return self._worlds[index]

  def bind(self, mjcf_elements: Any) -> '_BatchBinding':
    """Returns the binding of an element, or of a tuple or list of elements."""
    key = mjcf_elements
    if type(key) is list:
      key = tuple(key)
    binding = self._bindings.get(key)
    if binding is None:
      binding = _BatchBinding(self, self._template.bind(key))
      self._bindings[key] = binding
    return binding

  def mark_as_dirty(self) -> None:
    """Says that derived quantities are out of date."""
    self._is_dirty = True

  def forward(self) -> None:
    """Brings positions, velocities and what derives from them up to date."""
    self._batch.forward(stage=_STAGE)
    self._is_dirty = False

  def refresh(self) -> None:
    """Does `forward` where something has been written since the last one."""
    if self._is_dirty:
      self.forward()

  def advance(self, num_substeps: int) -> None:
    """Steps every world, from the state as it is."""
    self._batch.step(nstep=num_substeps)
    self._is_dirty = True

  def reset(self, worlds: np.ndarray) -> None:
    """Resets the state of some worlds, by number; nothing is derived yet."""
    self._batch.reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
    self._batch.warning[worlds] = 0
    self._is_dirty = True

  def set_state(self, worlds: np.ndarray, values: np.ndarray) -> None:
    """Gives some worlds, by number, other states, `(worlds, size)`."""
    self._batch.state[worlds] = values
    self._batch.warning[worlds] = 0
    self._is_dirty = True

  def has_diverged(self) -> np.ndarray:
    """Returns in which worlds MuJoCo has warned since a reset, `(worlds,)`."""
    numbers = np.asarray(self._batch.warning)[:, :, 1]
    return np.count_nonzero(numbers, axis=1) > 0

  def cast_rays(
      self, origin: np.ndarray, directions: np.ndarray, excluded_body: int
  ) -> tuple[np.ndarray, np.ndarray]:
    """Casts rays in every world; see `entities.rays.cast`."""
    self._ray_batch.state[:] = self._batch.state
    distances, geoms = self._ray_batch.ray(
        origin[:, np.newaxis, :], directions, bodyexclude=excluded_body
    )
    return distances, geoms

  def draw(self, camera: mjcf.Element, height: int, width: int) -> np.ndarray:
    """Draws a camera of every world; see `entities.cameras.render`."""
    frames = np.empty((self.num_envs, height, width, 3), np.uint8)
    for world, frame in enumerate(frames):
      frame[...] = self._shown(world).draw(camera, height, width)
    return frames

  def render(
      self, worlds: Iterable[int], camera: str, height: int, width: int
  ) -> np.ndarray:
    """Draws some worlds for people, as `mjcf.Physics.render` does.

    Args:
      worlds: Their numbers.
      camera: The name of a camera of the model.
      height: Of a frame, pixels.
      width: Of a frame, pixels.

    Returns:
      `(worlds, height, width, 3)` uint8.

    Raises:
      RenderingError: If nothing renders here, or not frames of this size.
    """
    try:
      return np.stack(
          [self._shown(w).render(height, width, camera_id=camera)
           for w in worlds]
      )  # fmt: skip
    except (RuntimeError, ValueError) as error:  # Whatever dm_control raises.
      raise errors.RenderingError(
          f'{camera}: no frame of {height} x {width} pixels'
          f' ({str(error).strip().splitlines()[0]})'
      ) from error

  def _shown(self, world: int) -> single_physics.ThinPhysics:
    """Returns the template in the state of a world; it has a renderer."""
    mujoco.mj_setState(
        self._template.model.ptr, self._template.data.ptr,
        self._batch.state[world], mujoco.mjtState.mjSTATE_INTEGRATION,
    )  # fmt: skip
    self._template.forward()
    return self._template

  def find(self, binding: Any, name: str) -> tuple[np.ndarray, Any]:
    """Returns the field of all worlds that an attribute is in, and where."""
    _, index = binding._get_cached_array_and_index(name)
    if name in _STATE_FIELDS:
      field = _STATE_FIELDS[name]
    else:
      field = _DERIVED_FIELDS[binding._namespace, name]
      # What derives from the state is only filled in from the next call on.
      self._is_dirty = True
    if not isinstance(index, int | np.integer | slice):
      index = np.asarray(index)
      if np.array_equal(index, np.arange(index[0], index[0] + len(index))):
        index = slice(int(index[0]), int(index[0]) + len(index))
    return self._batch.bind(field), index


@rays.cast.register
def _(
    physics: BatchPhysics,
    origin: np.ndarray,
    directions: np.ndarray,
    excluded_body: int,
) -> tuple[np.ndarray, np.ndarray]:
  return physics.cast_rays(origin, directions, excluded_body)


@cameras.render.register
def _(
    physics: BatchPhysics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  return physics.draw(camera, height, width)


@final
class _Userdata:
  """What entities look for as `physics.data`."""

  def __init__(self, userdata: np.ndarray) -> None:
    self.userdata = userdata


@final
class _WorldView:
  """One of the worlds, with the interface of a single one."""

  def __init__(self, physics: BatchPhysics, index: int) -> None:
    self._physics = physics
    self._index = index
    self._data = _Userdata(physics.data.userdata[index])
    self._bindings: dict[Any, _WorldBinding] = {}

  @property
  def model(self) -> Any:
    return self._physics.model

  @property
  def data(self) -> _Userdata:
    return self._data

  def bind(self, mjcf_elements: Any) -> '_WorldBinding':
    """Returns the binding of elements in this world."""
    key = mjcf_elements
    if type(key) is list:
      key = tuple(key)
    binding = self._bindings.get(key)
    if binding is None:
      binding = _WorldBinding(self._physics.bind(key), self._index)
      self._bindings[key] = binding
    return binding

  def mark_as_dirty(self) -> None:
    self._physics.mark_as_dirty()


def _attribute(name: str) -> property:
  """An attribute that `_get` reads and, if it is state, `_set` writes."""

  def get(self: Any) -> np.ndarray:
    return self._get(name)

  def put(self: Any, value: Any) -> None:
    self._set(name, value)

  return property(get, put if name in _STATE_FIELDS else None)


class _Binding(abc.ABC):
  """Elements, with the attributes that entities read and write whole."""

  qpos = _attribute('qpos')
  qvel = _attribute('qvel')
  ctrl = _attribute('ctrl')
  mocap_pos = _attribute('mocap_pos')
  mocap_quat = _attribute('mocap_quat')
  active = _attribute('active')
  xpos = _attribute('xpos')
  xmat = _attribute('xmat')

  def __init__(self, binding: Any) -> None:
    self._binding = binding

  @property
  def element_id(self) -> Any:
    """The number of the element in the model, or those of several."""
    return self._binding.element_id

  @abc.abstractmethod
  def _get(self, name: str) -> np.ndarray:
    """Returns an attribute, read-only."""

  @abc.abstractmethod
  def _set(self, name: str, value: Any) -> None:
    """Writes an attribute that is state."""


@final
class _BatchBinding(_Binding):
  """Elements of every world: arrays with a leading axis, read-only and live."""

  def __init__(self, physics: BatchPhysics, binding: Any) -> None:
    super().__init__(binding)
    self._physics = physics
    self._parts: dict[str, tuple[np.ndarray, Any]] = {}

  def part(self, name: str) -> tuple[np.ndarray, Any]:
    """Returns the field that an attribute is in, and where in it."""
    if name not in self._parts:
      self._parts[name] = self._physics.find(self._binding, name)
    return self._parts[name]

  def _get(self, name: str) -> np.ndarray:
    field, index = self.part(name)
    if name not in _STATE_FIELDS:
      self._physics.refresh()
    found = field[:, index]
    found.flags.writeable = False
    return found

  def mark_as_dirty(self) -> None:
    """Says that derived quantities are out of date."""
    self._physics.mark_as_dirty()

  def _set(self, name: str, value: Any) -> None:
    field, index = self.part(name)
    field[:, index] = value
    if name != 'ctrl':
      self._physics.mark_as_dirty()


@final
class _WorldBinding(_Binding):
  """Elements of one world of many."""

  def __init__(self, binding: _BatchBinding, world: int) -> None:
    super().__init__(binding)
    self._world = world

  def _get(self, name: str) -> np.ndarray:
    return getattr(self._binding, name)[self._world]

  def _set(self, name: str, value: Any) -> None:
    field, index = self._binding.part(name)
    field[self._world, index] = value
    self._binding.mark_as_dirty()

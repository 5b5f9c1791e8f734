"""Physics of a batch of worlds, with the interface that entities use.

Entities bind elements and index trailing axes, so the same code serves arrays
with a leading axis of worlds. `mujoco.batch.Batch` steps the worlds in threads.
Its state arrays are live. Derived quantities are updated when they are read.
"""

import abc
from collections.abc import Iterable
import copy
import ctypes
import functools
import operator
import os
from typing import Any, final
import weakref

from dm_control import mjcf
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from realab_suite import errors
from realab_suite.engine import arguments
from realab_suite.engine import single_physics
from realab_suite.entities import cameras
from realab_suite.entities import protocols
from realab_suite.entities import rays

# Positions and what derives from them, and what derives from velocities, too.
_POSITIONS = int(mujoco.mjtStage.mjSTAGE_POS)
_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)
# What the poses of bodies, geoms and sites do not depend on.
_NEEDLESS = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
)

# State field that contains each bound attribute.
_STATE_FIELDS = {
    'qpos': 'qpos',
    'qvel': 'qvel',
    'ctrl': 'ctrl',
    'mocap_pos': 'mocap_pos',
    'mocap_quat': 'mocap_quat',
    'active': 'eq_active',
}
# Derived field of each bound attribute, by the kind of the element.
_DERIVED_FIELDS = {
    ('body', 'xpos'): 'xpos',
    ('mocap_body', 'xpos'): 'xpos',
    ('site', 'xpos'): 'site_xpos',
    ('geom', 'xpos'): 'geom_xpos',
    ('body', 'xmat'): 'xmat',
    ('mocap_body', 'xmat'): 'xmat',
    ('site', 'xmat'): 'site_xmat',
    ('geom', 'xmat'): 'geom_xmat',
    ('body', 'cvel'): 'cvel',
    ('body', 'subtree_com'): 'subtree_com',
}
# MuJoCo's batches with threads, which only the process that made them has.
_threaded: weakref.WeakSet[Any] = weakref.WeakSet()


@final
class BatchPhysics:
  """Physics of a batch. Bound arrays have a leading axis of worlds."""

  def __init__(
      self,
      template: single_physics.ThinPhysics,
      num_envs: int,
      num_threads: int = 0,
      sleep: bool = False,
  ) -> None:
    """Creates worlds with the model of another physics.

    Args:
      template: Physics of a single world, which provides the model and the
        indices of elements. This object takes ownership of it and renders all
        worlds with it.
      num_envs: Number of worlds.
      num_threads: Number of threads that step them; 0 for all processors.
      sleep: True to let blocks at rest sleep.
    """
    self._template = template
    self._num_threads = arguments.num_threads(num_threads)
    self._process = os.getpid()
    self._model = template.model
    if sleep:
      # The compiled model specifies which bodies may sleep: all except the
      # avatar, because its motors can move it at any time.
      self._model = copy.copy(template.model)
      self._model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    # MuJoCo's state does not contain which bodies sleep. A persistent batch
    # keeps this, because it keeps all data of each world between steps.
    self._batch = self._new_batch(self._model, num_envs, sleep)
    self._data = _Data(self._batch.bind('userdata'), self._batch.bind('time'))
    self._bindings: dict[Any, _BatchBinding] = {}
    self._is_dirty = True
    self._stage = _POSITIONS
    self._worlds: dict[int, _WorldView] = {}

  def free(self) -> None:
    """Frees the worlds, which must not be used afterwards.

    Bindings and worlds refer to this object, so it would otherwise wait for
    Python's garbage collection.
    """
    self._bindings.clear()
    self._worlds.clear()

  @functools.cached_property
  def _poses(self) -> mujoco_batch.Batch:
    """Another batch: it computes poses and casts rays in a copy of the state.

    It ignores contacts and constraints, which would take several times as long,
    and no body sleeps in it, so all geoms are at their present positions.
    """
    still = copy.copy(self._template.model)
    still.opt.disableflags |= int(_NEEDLESS)
    return self._new_batch(still, self.num_envs)

  def _new_batch(
      self, model: Any, num_envs: int, persistent: bool = False
  ) -> mujoco_batch.Batch:
    """Returns a new batch of MuJoCo."""
    batch = mujoco_batch.Batch(
        model.ptr, num_envs, self._num_threads, persistent
    )
    if batch.nthread > 1:
      _threaded.add(batch._b)
    return batch

  def refuse_forks(self) -> None:
    """Refuses the use of threads that only the parent of this process has.

    Raises:
      ForkError: If this process was forked after the batch was made.
    """
    if os.getpid() != self._process and self._batch.nthread > 1:
      raise errors.ForkError(
          f'this batch: process {self._process} made it before it forked this'
          f' one, which lacks its {self._batch.nthread} threads and would wait'
          ' for them; load the batch in this process, or with num_threads=1,'
          ' or start processes with spawn'
      )

  @property
  def num_envs(self) -> int:
    """Number of worlds."""
    return int(self._batch.nsim)

  # Read many times in a control step: `model` as in `mjcf.Physics`, and `data`
  # with `userdata`, `(worlds, slots)`, live, and `time`.
  data = property(operator.attrgetter('_data'))
  model = property(operator.attrgetter('_model'))

  @property
  def state(self) -> np.ndarray:
    """Integration state of every world, `(worlds, size)`, live."""
    return self._batch.state

  def world(self, index: int) -> protocols.Physics:
    """Returns the physics of one world, as episodes need when they begin."""
    if index not in self._worlds:
      self._worlds[index] = _WorldView(self, index)
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
    """Marks derived quantities as out of date."""
    self._is_dirty = True

  def forward(self) -> None:
    """Updates the poses of bodies, geoms and sites."""
    self.refuse_forks()
    self._poses.state[:] = self._batch.state
    self._poses.forward(stage=self._stage)
    self._is_dirty = False

  def check(self) -> None:
    """Checks the positions and velocities that the last substep resulted in.

    MuJoCo resets worlds that have failed; see `has_diverged`.
    """
    for values in (self._batch.bind('qpos'), self._batch.bind('qvel')):
      # False for NaN.
      if not (np.abs(values) <= mujoco.mjMAXVAL).all():
        self._batch.forward(stage=_POSITIONS)

  def refresh(self) -> None:
    """Calls `forward` if the state has changed since the last call."""
    if self._is_dirty:
      self.forward()

  def advance(self, num_substeps: int) -> None:
    """Steps every world from its present state."""
    self.refuse_forks()
    self._batch.step(nstep=num_substeps)
    self._is_dirty = True

  def reset(self, worlds: np.ndarray) -> None:
    """Resets the states of worlds, given their indices.

    Derived quantities are not updated.
    """
    self.refuse_forks()
    self._batch.reset(worlds, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
    self._batch.warning[worlds] = 0
    self._is_dirty = True

  def set_state(self, worlds: np.ndarray, values: np.ndarray) -> None:
    """Sets the states of worlds.

    Args:
      worlds: Indices of the worlds.
      values: Integration states, `(worlds, size)`.
    """
    self._batch.state[worlds] = values
    self._batch.warning[worlds] = 0
    self._is_dirty = True

  def has_diverged(self) -> np.ndarray:
    """Returns which worlds have MuJoCo warnings since their reset.

    Returns:
      `(worlds,)` bool.
    """
    numbers = np.asarray(self._batch.warning)[:, :, 1]
    return np.count_nonzero(numbers, axis=1) > 0

  def cast_rays(
      self, origin: np.ndarray, directions: np.ndarray, excluded_body: int
  ) -> tuple[np.ndarray, np.ndarray]:
    """Casts rays in every world; see `entities.rays.cast`."""
    self.refresh()
    distances, geoms = self._poses.ray(
        origin[:, np.newaxis, :], directions, bodyexclude=excluded_body
    )
    return distances, geoms

  def draw(self, camera: mjcf.Element, height: int, width: int) -> np.ndarray:
    """Renders a camera in every world; see `entities.cameras.render`."""
    frames = np.empty((self.num_envs, height, width, 3), np.uint8)
    for world, frame in enumerate(frames):
      frame[...] = self._template_in(world).draw(camera, height, width)
    return frames

  def render(
      self, worlds: Iterable[int], camera: str, height: int, width: int
  ) -> np.ndarray:
    """Renders worlds for people, like `mjcf.Physics.render`.

    Args:
      worlds: Indices of the worlds.
      camera: Name of a camera of the model.
      height: Height of a frame, in pixels.
      width: Width of a frame, in pixels.

    Returns:
      The frames, `(worlds, height, width, 3)` uint8.

    Raises:
      RenderingError: If no renderer is available, or if it fails.
      SpecError: If the model has no room for the size.
    """
    from realab_suite.engine import gl_contexts  # As in `single_physics`.

    templates = map(self._template_in, worlds)
    return np.stack(
        [gl_contexts.frame(t, camera, height, width) for t in templates]
    )

  def _template_in(self, world: int) -> single_physics.ThinPhysics:
    """Returns the template, which can render, in the state of a world."""
    mujoco.mj_setState(
        self._template.model.ptr,
        self._template.data.ptr,
        self._batch.state[world],
        mujoco.mjtState.mjSTATE_INTEGRATION,
    )
    self._template.forward()
    return self._template

  def find(self, binding: Any, name: str) -> tuple[np.ndarray, Any]:
    """Returns the array of all worlds with an attribute, and its index there.

    Args:
      binding: Binding of elements in the template.
      name: Name of the attribute.
    """
    _, index = binding._get_cached_array_and_index(name)
    if name in _STATE_FIELDS:
      field = _STATE_FIELDS[name]
    else:
      field = _DERIVED_FIELDS[binding._namespace, name]
      # A derived field is filled from the next call of `forward` on.
      self._is_dirty = True
      if name == 'cvel':
        self._stage = _VELOCITIES
    if not isinstance(index, int | np.integer | slice):
      index = np.asarray(index)
      if np.array_equal(index, np.arange(index[0], index[0] + len(index))):
        index = slice(int(index[0]), int(index[0]) + len(index))
    batch = self._batch if name in _STATE_FIELDS else self._poses
    return batch.bind(field), index


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
class _Data:
  """The part of `physics.data` that entities use."""

  def __init__(self, userdata: np.ndarray, time: np.ndarray) -> None:
    self.userdata = userdata
    self.times = time

  @property
  def time(self) -> np.ndarray:
    """Time since the start of the episode, `(...)`, in s."""
    return np.array(self.times)[()]


@final
class _WorldView:
  """One world of a batch, with the interface of a single world."""

  def __init__(self, physics: BatchPhysics, index: int) -> None:
    self._physics = physics
    self._index = index
    data = physics.data
    self._data = _Data(data.userdata[index], data.times[index, ...])
    self._bindings: dict[Any, _WorldBinding] = {}

  @property
  def model(self) -> Any:
    return self._physics.model

  @property
  def data(self) -> _Data:
    return self._data

  @property
  def state(self) -> np.ndarray:
    """Integration state of the world, `(size,)`, live."""
    state: np.ndarray = self._physics.state[self._index]
    return state

  def bind(self, mjcf_elements: Any) -> '_WorldBinding':
    """Returns the binding of an element, or of a tuple or list of elements."""
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
  """Returns a property that calls `_get` and, for state, `_set`."""

  def get(self: Any) -> np.ndarray:
    return self._get(name)

  def put(self: Any, value: Any) -> None:
    self._set(name, value)

  return property(get, put if name in _STATE_FIELDS else None)


class _Binding(abc.ABC):
  """Bound elements. Attributes are read and written whole."""

  qpos = _attribute('qpos')
  qvel = _attribute('qvel')
  ctrl = _attribute('ctrl')
  mocap_pos = _attribute('mocap_pos')
  mocap_quat = _attribute('mocap_quat')
  active = _attribute('active')
  xpos = _attribute('xpos')
  xmat = _attribute('xmat')
  cvel = _attribute('cvel')
  subtree_com = _attribute('subtree_com')

  def __init__(self, binding: Any) -> None:
    self._binding = binding

  @property
  def element_id(self) -> Any:
    """Number of the element in the model, or of each element."""
    return self._binding.element_id

  @abc.abstractmethod
  def _get(self, name: str) -> np.ndarray:
    """Returns an attribute as a read-only array."""

  @abc.abstractmethod
  def _set(self, name: str, value: Any) -> None:
    """Writes an attribute of the state."""


@final
class _BatchBinding(_Binding):
  """Elements of every world, as live, read-only arrays with a leading axis."""

  def __init__(self, physics: BatchPhysics, binding: Any) -> None:
    super().__init__(binding)
    self._physics = physics
    self._parts: dict[str, tuple[np.ndarray, Any]] = {}

  def part(self, name: str) -> tuple[np.ndarray, Any]:
    """Returns the array that contains an attribute, and its index there."""
    if name not in self._parts:
      self._parts[name] = self._physics.find(self._binding, name)
    return self._parts[name]

  def _get(self, name: str) -> np.ndarray:
    field, index = self.part(name)
    if name not in _STATE_FIELDS:
      self._physics.refresh()
    values = field[:, index]
    values.flags.writeable = False
    return values

  def mark_as_dirty(self) -> None:
    """Marks derived quantities as out of date."""
    self._physics.mark_as_dirty()

  def _set(self, name: str, value: Any) -> None:
    field, index = self.part(name)
    field[:, index] = value
    if name != 'ctrl':
      self._physics.mark_as_dirty()


@final
class _WorldBinding(_Binding):
  """Elements of one world of a batch."""

  def __init__(self, binding: _BatchBinding, world: int) -> None:
    super().__init__(binding)
    self._world = world

  def _get(self, name: str) -> np.ndarray:
    return getattr(self._binding, name)[self._world]

  def _set(self, name: str, value: Any) -> None:
    field, index = self._binding.part(name)
    field[self._world, index] = value
    self._binding.mark_as_dirty()


def _leave_threads() -> None:
  """Keeps batches in a forked process, as freeing them would join threads."""
  for batch in _threaded:
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))


os.register_at_fork(after_in_child=_leave_threads)

"""Physics of one world, with little overhead between MuJoCo and Python."""

import operator
from typing import TYPE_CHECKING, Any, final

from dm_control import mjcf
from dm_control.mjcf import physics as mjcf_physics
from dm_control.rl import control
import mujoco
import numpy as np

from realab_suite.entities import cameras

if TYPE_CHECKING:
  from realab_suite.engine import frame_renderer

# Attributes of bound elements that belong to the state.
_STATE = ('qpos', 'qvel', 'ctrl', 'mocap_pos', 'mocap_quat', 'active')


@final
class ThinPhysics(mjcf.Physics):
  """A faster `mjcf.Physics` for tasks of this package.

  It differs from `mjcf.Physics` in three ways:

  - Steps begin from the state. Composer begins a step with the derived
    quantities of the previous step, which are wrong for one substep after each
    write to a register unless everything is recomputed. Here, a step computes
    the quantities that it needs, and the others are updated when they are read.
  - Poses are updated without everything else that derives from positions, such
    as contacts, which takes several times as long.
  - Bindings are thin. An access to one of Composer's takes 2 to 10
    microseconds, because it supports every use. Here, views of the state are
    created once. They are read-only and live: later steps change them. Bound
    attributes have to be written whole.
  """

  def _reload_from_data(self, data: Any) -> None:
    self._compiled = data.model
    self._pointers = data.model.ptr, data.ptr
    self._num_warnings = data.ptr.warning.number
    self.has_old_poses = True
    super()._reload_from_data(data)
    self._thin: dict[Any, _ThinBinding] = {}
    # One for each size of frames, (height, width).
    self._renderers: dict[Any, frame_renderer.FrameRenderer] = {}

  # Read many times in a control step; dm_control's are functions in Python.
  data = property(operator.attrgetter('_data'))
  model = property(operator.attrgetter('_compiled'))

  def forward(self) -> None:
    """Updates the quantities derived from positions and velocities.

    Accelerations and contact forces remain those of the last substep, as in
    Composer. Computing them would change the solver's warm start, so that
    reading would change the trajectory.

    Raises:
      PhysicsError: If MuJoCo issued a warning.
    """
    mujoco.mj_step1(*self._pointers)
    self._dirty = self.has_old_poses = False
    if any(self._num_warnings.tolist()):
      raise _failure(self._num_warnings)

  def update_poses(self) -> None:
    """Updates the poses of bodies, geoms and sites if the state has changed."""
    if self.has_old_poses:
      mujoco.mj_kinematics(*self._pointers)
      self.has_old_poses = False

  def check(self) -> None:
    """Checks the positions and velocities that the last substep resulted in.

    Raises:
      PhysicsError: If MuJoCo issued a warning.
    """
    mujoco.mj_checkPos(*self._pointers)
    mujoco.mj_checkVel(*self._pointers)
    if any(self._num_warnings.tolist()):
      raise _failure(self._num_warnings)

  @property
  def state(self) -> np.ndarray:
    """Integration state, `(size,)`."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(self._pointers[0], kind))
    mujoco.mj_getState(*self._pointers, state, kind)
    return state

  def mark_as_dirty(self) -> None:
    """Marks derived quantities as out of date."""
    self._dirty = self.has_old_poses = True

  def refresh(self) -> None:
    """Calls `forward` if the state has changed since the last call."""
    if self._dirty:
      self.forward()

  def reset(self, keyframe_id: int | None = None) -> None:
    """Resets the state and computes accelerations without actuation."""
    super().reset(keyframe_id)
    with self.model.disable('actuation'):
      mujoco.mj_forward(self.model.ptr, self.data.ptr)
    self.mark_as_dirty()

  def advance(self, num_substeps: int) -> None:
    """Steps the physics from its present state.

    Raises:
      PhysicsError: If MuJoCo issued a warning. MuJoCo has then reset the state,
        so nothing may be read from it.
    """
    mujoco.mj_step(*self._pointers, num_substeps)
    self._dirty = self.has_old_poses = True
    if any(self._num_warnings.tolist()):
      raise _failure(self._num_warnings)

  def _make_rendering_contexts(self) -> None:
    """Creates the contexts for `render`.

    Raises:
      RenderingError: If no renderer is available.
    """
    # Most programs make no pictures.
    from realab_suite.engine import gl_contexts

    self._contexts = gl_contexts.for_pictures(self.model)

  def free(self) -> None:
    """Frees the world, which must not be used afterwards."""
    for renderer in self._renderers.values():
      renderer.free()
    super().free()

  def bind(self, mjcf_elements: Any) -> Any:
    """Returns the binding of an element, or of a tuple or list of elements."""
    key = mjcf_elements
    if type(key) is list:
      key = tuple(key)
    try:
      return self._thin[key]
    except KeyError:
      if not key:
        return super().bind(key)
      namespace, names = mjcf_physics.names_from_elements(key)
      self._thin[key] = _ThinBinding(self, namespace, names)
      return self._thin[key]

  def render(self, *args: Any, **kwargs: Any) -> np.ndarray:
    """Renders a camera for people; see `mjcf.Physics.render`."""
    self.refresh()
    return super().render(*args, **kwargs)

  def draw(self, camera: mjcf.Element, height: int, width: int) -> np.ndarray:
    """Renders a camera for an agent. Use `render` for people.

    Args:
      camera: Camera of the model.
      height: Height of the frame, in pixels.
      width: Width of the frame, in pixels.

    Returns:
      A new array, `(height, width, 3)` uint8.

    Raises:
      ForkError: If this process was forked after the first frame.
      RenderingError: If no renderer is available, or if another thread rendered
        the first frame.
    """
    self.refresh()
    size = height, width
    if size not in self._renderers:
      from realab_suite.engine import frame_renderer

      self._renderers[size] = frame_renderer.FrameRenderer(
          self.model.ptr, height, width
      )
    camera_id = self.bind(camera).element_id
    return self._renderers[size].draw(self.data.ptr, camera_id)


@cameras.render.register
def _(
    physics: ThinPhysics, camera: mjcf.Element, height: int, width: int
) -> np.ndarray:
  return physics.draw(camera, height, width)


def _view(array: np.ndarray, index: Any) -> np.ndarray | None:
  """Returns a view of indexed elements, or `None` if a view is impossible."""
  if isinstance(index, int | np.integer):
    return array[index, ...]
  if isinstance(index, slice):
    return array[index]
  index = np.asarray(index)
  start = int(index[0])
  if np.array_equal(index, np.arange(start, start + len(index))):
    return array[start : start + len(index)]
  return None


def _pose_property(name: str) -> property:
  """Returns a property for a pose, which is updated when it is read."""

  def get(self: '_ThinBinding') -> np.ndarray:
    if self._physics.has_old_poses:
      self._physics.update_poses()
    try:
      return self._reads[name]
    except KeyError:
      return self._read(name)

  return property(get)


def _derived_property(name: str) -> property:
  """Returns a property for an attribute that is updated when it is read."""

  def get(self: '_ThinBinding') -> np.ndarray:
    self._physics.refresh()
    return self._read(name)

  return property(get)


@final
class _ThinBinding(mjcf_physics.Binding):
  """A binding with fast access to the attributes that entities use.

  Views of the state are in slots, so that reading one calls no Python function.
  Attributes that are not listed here work as in Composer.
  """

  __slots__ = (*_STATE, '_reads', '_writes')

  _reads: dict[str, np.ndarray]
  _writes: dict[str, tuple[np.ndarray, Any]]

  xpos = _pose_property('xpos')
  xmat = _pose_property('xmat')
  cvel = _derived_property('cvel')
  subtree_com = _derived_property('subtree_com')

  def __init__(self, physics: ThinPhysics, namespace: str, names: Any) -> None:
    object.__setattr__(self, '_reads', {})
    object.__setattr__(self, '_writes', {})
    super().__init__(physics, namespace, names)

  def __getattr__(self, name: str) -> Any:
    # Also called for a state attribute whose slot is empty: before it is read,
    # and if no view of it is possible.
    return self._read(name) if name in _STATE else super().__getattr__(name)

  def __setattr__(self, name: str, value: Any) -> None:
    if name not in _STATE:
      super().__setattr__(name, value)
      return
    array, index = self._writes.get(name) or self._find(name)
    array[index] = value
    if name != 'ctrl':
      self._physics._dirty = self._physics.has_old_poses = True

  def _find(self, name: str) -> tuple[np.ndarray, Any]:
    """Finds and caches the array of an attribute and the index in it."""
    array, index = self._get_cached_array_and_index(name)
    array = np.asarray(array)
    view = _view(array, index)
    if view is None:
      self._writes[name] = array, np.asarray(index)
    else:
      self._writes[name] = view, ...
      self._reads[name] = view.view()
      self._reads[name].flags.writeable = False
      if name in _STATE:
        object.__setattr__(self, name, self._reads[name])
    return self._writes[name]

  def _read(self, name: str) -> np.ndarray:
    if name not in self._writes:
      self._find(name)
    if name in self._reads:
      return self._reads[name]
    array, index = self._writes[name]
    copy = array[index]
    copy.flags.writeable = False
    return copy


def _failure(numbers: np.ndarray) -> control.PhysicsError:
  """Returns an error for warnings of MuJoCo, given the number of each."""
  raised = [mujoco.mjtWarning(int(i)).name for i in np.flatnonzero(numbers)]
  return control.PhysicsError(f'MuJoCo warnings: {", ".join(raised)}')

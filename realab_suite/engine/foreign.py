"""Foreign tasks: Composer tasks of other packages, stepped as in Composer.

With a design without registers, the observations, rewards, discounts and step
types of a foreign task equal those of `composer.Environment`, bit for bit. A
foreign task may have hooks in substeps, may keep state in Python, and is
compiled for each episode, except a `control_tasks.ControlTask`. Batches and
snapshots therefore do not support it.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
import contextlib
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer import observation as composer_observation
from dm_env import specs
import mujoco
import numpy as np

from realab_suite.engine import control_tasks
from realab_suite.engine import gl_contexts
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import replacement
from realab_suite.engine import solids
from realab_suite.feedback import mechanisms
from realab_suite.tasks import base


@final
class ForeignPhysics(mjcf.Physics):
  """`mjcf.Physics` with the methods that the engine calls.

  Composer recomputes accelerations, and the sensors that measure them, when a
  bound attribute is read after a write. A write to a register must not cause
  this, because the task would then observe other values. The registers are
  therefore read and written between `pause` and `resume`.
  """

  _is_paused = False
  _was_dirty = False

  def pause(self) -> None:
    """Ends a part of the task's control step."""
    self._is_paused, self._was_dirty = True, self._dirty

  def resume(self) -> None:
    """Continues the task's control step after writes to registers."""
    if self._is_paused:
      self.refresh()
      self._is_paused, self._dirty = False, self._was_dirty

  def forward(self) -> None:
    """Updates derived quantities; between `pause` and `resume`, only poses."""
    if self._is_paused:
      self.refresh()
    else:
      super().forward()

  def reset(self, keyframe_id: int | None = None) -> None:
    """Resets the state, also after an exception in a pause."""
    self._is_paused = False
    super().reset(keyframe_id)

  def refresh(self) -> None:
    """Updates the quantities derived from positions and velocities."""
    refresh(self)
    self._dirty = False

  def check(self) -> None:
    """Does nothing, because `step` checks its result."""

  def advance(self, num_substeps: int) -> None:
    """Runs substeps in the same way as Composer."""
    self.step(num_substeps)

  def _make_rendering_contexts(self) -> None:
    """Creates the contexts for `render`.

    Raises:
      RenderingError: If no renderer is available.
    """
    self._contexts = gl_contexts.for_pictures(self.model)


@contextlib.contextmanager
def unchanged(physics: mjcf.Physics) -> Iterator[None]:
  """Returns a context in which reads do not change later steps.

  Reading a bound attribute after a write recomputes all derived quantities and
  replaces the solver's warm start. The context restores it.

  Args:
    physics: Physics of a foreign task.
  """
  is_dirty = physics.is_dirty
  warm_start = np.array(physics.data.qacc_warmstart)
  try:
    yield
  finally:
    physics.data.qacc_warmstart[:] = warm_start
    if is_dirty:
      physics.mark_as_dirty()


def refresh(physics: mjcf.Physics) -> None:
  """Updates the quantities derived from positions and velocities.

  Composer begins a step with the derived quantities of the previous step, which
  are wrong after a write to a register. Unlike `physics.forward`, this function
  does not change accelerations and the solver's warm start.

  Args:
    physics: Physics of one world.

  Raises:
    PhysicsError: If MuJoCo issued a warning.
  """
  with physics.check_invalid_state():
    mujoco.mj_step1(physics.model.ptr, physics.data.ptr)


@final
class ForeignHost(hosts.Host):
  """Host of a foreign task.

  The senses that the task offers are the observables that were enabled when it
  was embedded. Observables that are enabled later are not observed.
  """

  def __init__(
      self,
      task: composer.Task,
      hooks: Any,
      random_state: np.random.RandomState,
      updater: Callable[[], composer_observation.Updater],
      has_registers: bool,
  ) -> None:
    """Initializes the host.

    Args:
      task: Foreign task.
      hooks: All hooks of the `composer.Environment`.
      random_state: Random generator for the hooks.
      updater: Function that returns the observation updater of the present
        compiled model.
      has_registers: True if the design has registers.
    """
    self._task = task
    self._hooks = hooks
    self._random_state = random_state
    self._updater = updater
    self._has_registers = has_registers
    self._sense_spec = dict(updater().observation_spec())

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    return self._sense_spec

  @property
  def default_senses(self) -> Sequence[str]:
    return tuple(self._sense_spec)

  def sense(
      self, physics: hosts.SteppedPhysics, names: Collection[str]
  ) -> dict[str, np.ndarray]:
    del physics  # The updater has read it already.
    seen = self._updater().get_observation()
    return {n: np.array(seen[n]) for n in names if n in seen}

  def begin_step(
      self, physics: hosts.SteppedPhysics, controls: np.ndarray
  ) -> None:
    self._hooks.before_step(physics, controls, self._random_state)
    self._updater().prepare_for_next_control_step()
    self._pause(physics)

  def advance(
      self,
      physics: hosts.SteppedPhysics,
      controls: np.ndarray,
      num_substeps: int,
      is_last: bool,
  ) -> None:
    if not num_substeps:
      return
    _foreign(physics).resume()
    for i in range(num_substeps):
      self._hooks.before_substep(physics, controls, self._random_state)
      physics.advance(1)
      self._hooks.after_substep(physics, self._random_state)
      # The update of the last substep comes after `after_step`.
      if not (is_last and i == num_substeps - 1):
        self._updater().update()
    if is_last:
      self._hooks.after_step(physics, self._random_state)
      self._updater().update()
    else:
      self._pause(physics)

  def _pause(self, physics: hosts.SteppedPhysics) -> None:
    if self._has_registers:
      _foreign(physics).pause()

  def is_over(self, physics: hosts.SteppedPhysics) -> bool:
    del physics  # Composer checks only at the end of a step.
    return False

  def end_step(
      self, physics: hosts.SteppedPhysics, was_over: Any, is_ending: Any
  ) -> hosts.Ending:
    del was_over, is_ending
    reward, failure = hosts.true_reward(
        lambda: float(self._task.get_reward(physics)), np.nan
    )
    return hosts.Ending(
        reward,
        failure,
        float(self._task.get_discount(physics)),
        bool(self._task.should_terminate_episode(physics)),
    )


def _foreign(physics: Any) -> ForeignPhysics:
  return physics


def is_recompiled(task: composer.Task) -> bool:
  """Returns True if the model of a task may change between episodes."""
  return not isinstance(task, base.Task | control_tasks.ControlTask)


@contextlib.contextmanager
def initializing(
    physics: mjcf.Physics,
    task: composer.Task,
    mechanism: mechanisms.FeedbackMechanism,
) -> Iterator[None]:
  """Returns the context in which an episode is initialized.

  Foreign tasks look for positions without any contacts, and for directions
  without walls. In the context, blocks of registers therefore touch nothing,
  not even the floor they stand on, and rays pass through them. At the end, the
  registers of a task that is recompiled are placed where nothing else is.

  Args:
    physics: Physics of one world.
    task: Task of this package, or a foreign task.
    mechanism: Registers, meters and providers.

  Raises:
    EpisodeInitializationError: If there is no clear place for a register. The
      next attempt generates another world.
  """
  with physics.reset_context():
    if not isinstance(physics, ForeignPhysics):
      yield
      return
    model = physics.model
    geoms = [physics.bind(geom).element_id for geom in _geoms(mechanism)]
    # Rays pass through geoms without opacity.
    values = model.geom_contype, model.geom_conaffinity, model.geom_rgba[:, 3]
    before = [value[geoms].copy() for value in values]
    try:
      for value in values:
        value[geoms] = 0
      yield
    finally:
      for value, old in zip(values, before, strict=True):
        value[geoms] = old
    if is_recompiled(task):
      replacement.place(physics, mechanism)


def _geoms(mechanism: mechanisms.FeedbackMechanism) -> dict[Any, str]:
  """Returns the names of registers by the geoms of their blocks."""
  return {
      block.geom: name
      for name, register in mechanism.registers.items()
      for block in register.blocks
  }


def check_start(
    physics: mjcf.Physics, mechanism: mechanisms.FeedbackMechanism
) -> None:
  """Checks that no episode begins with something inside a register.

  Args:
    physics: Physics at the start of an episode.
    mechanism: Registers, meters and providers.

  Raises:
    EpisodeInitializationError: If something is. The next attempt draws other
      positions.
  """
  owners = {
      int(physics.bind(geom).element_id): name
      for geom, name in _geoms(mechanism).items()
  }
  model, contacts = physics.model, physics.data.ptr.contact
  for (one, other), depth in zip(contacts.geom, -contacts.dist, strict=True):
    block, body = (one, other) if one in owners else (other, one)
    if block not in owners or body in owners:
      continue
    if model.geom_type[body] == mujoco.mjtGeom.mjGEOM_HFIELD:
      continue  # Uneven ground, which lifts a block.
    if depth > solids.TOLERANCE:
      name = model.id2name(int(body), 'geom') or f'geom {body}'
      raise composer.EpisodeInitializationError(
          f'design {mechanism.design.name!r}: register {owners[block]!r} would'
          f' be {depth:.2g} m inside {name!r} when the episode begins; place it'
          ' elsewhere'
      )


def make_host(
    task: composer.Task,
    hooks: Any,
    random_state: np.random.RandomState,
    updater: Callable[[], composer_observation.Updater],
    has_registers: bool,
) -> hosts.Host:
  """Returns the host of one world.

  Args:
    task: Task of this package, or a foreign task.
    hooks: All hooks of the `composer.Environment`.
    random_state: Random generator for the hooks.
    updater: See `ForeignHost`.
    has_registers: True if the design has registers.
  """
  if isinstance(task, base.Task):
    return hosts.WorldHost(task, hooks, random_state, ())
  return ForeignHost(task, hooks, random_state, updater, has_registers)


def make_updater(
    task: composer.Task, senses: Sequence[str]
) -> composer_observation.Updater:
  """Returns an updater of the selected observables of a foreign task.

  Observables that are not selected are not computed.

  Args:
    task: Foreign task.
    senses: Names of the selected senses.

  Raises:
    SpecError: If a name is not that of an enabled observable.
  """
  enabled = {
      name: observable
      for name, observable in task.observables.items()
      if observable.enabled
  }
  observing.refuse_unknown(senses, [*enabled, observing.TIME_LEFT])
  return composer_observation.Updater(
      {name: enabled[name] for name in enabled if name in senses},
      task.physics_steps_per_control_step,
      strip_singleton_buffer_dim=True,
  )

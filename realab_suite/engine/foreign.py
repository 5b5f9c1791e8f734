"""Foreign tasks: Composer tasks of other packages, stepped as in Composer.

With a design without registers, the observations, rewards, discounts and step
types of a foreign task equal those of `composer.Environment`, bit for bit. A
foreign task may have hooks in substeps, may keep state in Python, and is
compiled for each episode. Batches and snapshots therefore do not support it.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
import contextlib
import functools
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer import observation as composer_observation
from dm_control.rl import control
from dm_env import specs
import mujoco
import numpy as np

from realab_suite.engine import clearance
from realab_suite.engine import gl_contexts
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import placement
from realab_suite.engine import replacement
from realab_suite.entities import meters
from realab_suite.entities import views
from realab_suite.feedback import mechanisms


@final
class ForeignPhysics(mjcf.Physics):
  """`mjcf.Physics` with the methods that the engine calls."""

  def refresh(self) -> None:
    """Updates the quantities derived from positions and velocities."""
    views.refresh(self)
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


@final
class ForeignHost(hosts.Host):
  """Host of a foreign task.

  The senses that the task offers are the observables that are enabled when an
  episode begins, except those of meters and providers.
  """

  PHYSICS = ForeignPhysics
  IS_RECOMPILED = True

  def __init__(self, task: composer.Task) -> None:
    """Initializes the host.

    Args:
      task: Foreign task.
    """
    self._task = task
    self._hooks: Any = task
    self._random_state: np.random.RandomState | None = None
    self._updater: hosts.UpdaterOf = lambda: self.make_updater(None)
    self._view: views.View | None = None
    self._has_registers = False

  def make_updater(
      self, senses: Sequence[str] | None, added: Collection[str] = ()
  ) -> composer_observation.Updater:
    """Returns an updater of the selected observables.

    Observables that are not selected are not computed.

    Args:
      senses: Names of the selected senses; `None` for all enabled observables.
      added: Names of senses that providers have as well, if they are offered.

    Raises:
      SpecError: If a name is not that of an enabled observable.
    """
    selected = {
        name: observable
        for name, observable in self._task.observables.items()
        if observable.enabled and not isinstance(observable, meters.Unseen)
    }
    if senses is not None:
      observing.refuse_unknown(senses, [*selected, observing.TIME_LEFT])
      wanted = {*senses, *added}
      selected = {n: one for n, one in selected.items() if n in wanted}
    return composer_observation.Updater(
        selected,
        self._task.physics_steps_per_control_step,
        strip_singleton_buffer_dim=True,
    )

  def check_placement(
      self, physics: Any, mechanism: mechanisms.FeedbackMechanism, start: Any
  ) -> None:
    del start
    placement.check(physics, self._task.root_entity, mechanism)

  def start_check(
      self, physics: Any, mechanism: mechanisms.FeedbackMechanism
  ) -> Callable[[Any], None]:
    del physics  # The model changes between episodes.
    return functools.partial(check_start, mechanism=mechanism)

  def start(
      self,
      mechanism: mechanisms.FeedbackMechanism,
      step_hooks: Any,
      random_state: np.random.RandomState | None,
      updater: hosts.UpdaterOf,
  ) -> None:
    self._has_registers = bool(mechanism.registers)
    self._hooks = step_hooks
    self._random_state = random_state
    self._updater = updater
    self._sense_spec = dict(updater().observation_spec())

  @contextlib.contextmanager
  def initializing(
      self, physics: Any, mechanism: mechanisms.FeedbackMechanism
  ) -> Iterator[None]:
    """Returns the context in which an episode is initialized.

    Foreign tasks look for positions without any contacts, and for directions
    without walls. In the context, blocks of registers therefore touch nothing,
    not even the floor they stand on, and rays pass through them. At the end,
    registers are placed where nothing else is.

    Args:
      physics: Physics of one world.
      mechanism: Registers, meters and providers.

    Raises:
      EpisodeInitializationError: If there is no clear place for a register. The
        next attempt generates another world.
    """
    model = physics.model
    self._view = None  # It would keep the previous world alive.
    with physics.reset_context():
      geoms = list(clearance.owners(physics, mechanism.registers))
      # Rays pass through geoms without opacity.
      values = (
          model.geom_contype,
          model.geom_conaffinity,
          model.geom_rgba[:, 3],
      )
      before = [value[geoms].copy() for value in values]
      try:
        for value in values:
          value[geoms] = 0
        yield
      finally:
        for value, old in zip(values, before, strict=True):
          value[geoms] = old
      replacement.place(physics, mechanism)

  def begin_observing(self, physics: Any) -> None:
    self._updater().reset(physics, self._random_state)

  def unchanged(self, physics: Any) -> contextlib.AbstractContextManager[None]:
    return unchanged(physics)

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    return self._sense_spec

  def sense(
      self, physics: hosts.SteppedPhysics, names: Collection[str]
  ) -> dict[str, np.ndarray]:
    del physics  # The updater has read it already.
    observation = self._updater().get_observation()
    return {n: np.array(observation[n]) for n in names if n in observation}

  def begin_step(
      self, physics: hosts.SteppedPhysics, controls: np.ndarray
  ) -> None:
    self._hooks.before_step(physics, controls, self._random_state)
    self._updater().prepare_for_next_control_step()
    self._begin_access(physics)

  def advance(
      self,
      physics: hosts.SteppedPhysics,
      controls: np.ndarray,
      num_substeps: int,
      is_last: bool,
  ) -> None:
    if not num_substeps:
      return
    if self._has_registers:
      self.view(physics).refresh()
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
      self._begin_access(physics)

  def view(self, physics: Any) -> Any:
    if not self._has_registers:
      return physics
    if self._view is None:
      self._view = views.View(physics)
    return self._view

  def _begin_access(self, physics: Any) -> None:
    """Begins a part of the step in which registers are accessed."""
    if self._has_registers:
      self.view(physics).open(physics)

  def end_step(
      self, physics: hosts.SteppedPhysics, was_over: Any, is_ending: Any
  ) -> hosts.Ending:
    del was_over, is_ending
    reward, failure = hosts.true_reward(self._task, physics, float)
    return hosts.Ending(
        reward,
        failure,
        float(self._task.get_discount(physics)),
        bool(self._task.should_terminate_episode(physics)),
    )


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
  owners = clearance.owners(physics, mechanism.registers)
  model, contacts = physics.model, physics.data.ptr.contact
  for (first, second), depth in zip(contacts.geom, -contacts.dist, strict=True):
    block, body = (first, second) if first in owners else (second, first)
    if block not in owners or body in owners:
      continue
    if model.geom_type[body] == mujoco.mjtGeom.mjGEOM_HFIELD:
      continue  # Uneven ground, which lifts a block.
    if depth > clearance.TOLERANCE:
      name = model.id2name(int(body), 'geom') or f'geom {body}'
      raise composer.EpisodeInitializationError(
          f'design {mechanism.design.name!r}: register {owners[block]!r} would'
          f' be {depth:.2g} m inside {name!r} when the episode begins; place it'
          ' elsewhere'
      )


def hint(given: Any) -> str:
  """Returns what to pass instead of something that is no Composer task."""
  if isinstance(given, type):
    return '; this is a class: pass an instance'
  found = _task_of(given)
  if isinstance(found, composer.Task):
    return '; this is an environment: pass its `.task`'
  if isinstance(found or given, control.Task):
    return '; tasks of dm_control.suite are no Composer tasks'
  return ''


def _task_of(environment: Any) -> Any:
  """Returns the task of an environment below up to 10 wrappers, or `None`."""
  for _ in range(10):
    if hasattr(environment, 'task'):
      return environment.task
    fields = getattr(environment, '__dict__', {})
    # Wrappers of Gymnasium, Shimmy and dm_env use these names.
    names = {'env', '_env', '_environment'} & fields.keys()
    environment = fields[names.pop()] if names else None
  return None

"""Foreign tasks: Composer tasks of other packages, stepped as in Composer.

With a design without registers, the observations, rewards, discounts and step
types of a foreign task equal those of `composer.Environment`, bit for bit. A
foreign task may have hooks in substeps, may keep state in Python, and is
compiled for each episode. Batches and snapshots therefore do not support it.
"""

from collections.abc import Collection, Iterator
import contextlib
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer import observation as composer_observation
from dm_control.rl import control
from dm_env import specs
import mujoco
import numpy as np

from realab_suite.engine import clearance
from realab_suite.engine import control_step
from realab_suite.engine import environment
from realab_suite.engine import gl_contexts
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import placement
from realab_suite.engine import replacement
from realab_suite.entities import meters
from realab_suite.feedback import composer_hooks
from realab_suite.feedback import mechanisms


@final
class ForeignPhysics(mjcf.Physics):
  """`mjcf.Physics` that draws with the renderer of this package."""

  def _make_rendering_contexts(self) -> None:
    """Creates the contexts for `render`.

    Raises:
      RenderingError: If no renderer is available.
    """
    self._contexts = gl_contexts.for_pictures(self.model)


@final
class ForeignEnvironment(environment.Environment):
  """The environment of a foreign task.

  It is that of Composer, in which hooks of the mechanism run the phases, with a
  layer around it for actions, senses, signals and the true reward. The senses
  that the task offers are the observables that are enabled when an episode
  begins, except those of meters and providers.
  """

  PHYSICS = ForeignPhysics
  IS_RECOMPILED = True

  def __init__(
      self,
      task: composer.Task,
      mechanism: mechanisms.FeedbackMechanism,
      **options: Any,
  ) -> None:
    """Initializes the environment; see `environment.Environment`."""
    # Without registers, nothing is between Composer and the task.
    self._phase_hooks: composer_hooks.EmbeddedHooks | None = None
    if mechanism.registers:
      self._phase_hooks = composer_hooks.EmbeddedHooks(mechanism)
    mechanism.leave_phases(self._phase_hooks)
    super().__init__(task, mechanism, **options)

  def check_placement(self) -> None:
    self._refuse_if_closed()
    placement.check(self._physics, self._task.root_entity, self._mechanism)

  def check_start(self, physics: Any) -> None:
    owners = clearance.owners(physics, self._mechanism.registers)
    model, contacts = physics.model, physics.data.ptr.contact
    depths = -contacts.dist
    for (first, second), depth in zip(contacts.geom, depths, strict=True):
      block, body = (first, second) if first in owners else (second, first)
      if block not in owners or body in owners:
        continue
      if model.geom_type[body] == mujoco.mjtGeom.mjGEOM_HFIELD:
        continue  # Uneven ground, which lifts a block.
      if depth > clearance.TOLERANCE:
        name = model.id2name(int(body), 'geom') or f'geom {body}'
        raise composer.EpisodeInitializationError(
            f'design {self._mechanism.design.name!r}: register'
            f' {owners[block]!r} would be {depth:.2g} m inside {name!r} when'
            ' the episode begins; place it elsewhere'
        )

  @contextlib.contextmanager
  def _initializing(self) -> Iterator[None]:
    """Returns the context in which an episode is initialized.

    Foreign tasks look for positions without any contacts, and for directions
    without walls. In the context, blocks of registers therefore touch nothing,
    not even the floor they stand on, and rays pass through them. At the end,
    registers are placed where nothing else is.

    Raises:
      EpisodeInitializationError: If there is no clear place for a register. The
        next attempt generates another world.
    """
    physics = self._physics
    model = physics.model
    with physics.reset_context():
      geoms = list(clearance.owners(physics, self._mechanism.registers))
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
      replacement.place(physics, self._mechanism)

  @contextlib.contextmanager
  def _unchanged(self) -> Iterator[None]:
    """Returns a context in which reads do not change later steps.

    Reading a bound attribute after a write recomputes all derived quantities
    and replaces the solver's warm start. The context restores it.
    """
    physics = self._physics
    is_dirty = physics.is_dirty
    warm_start = np.array(physics.data.qacc_warmstart)
    try:
      yield
    finally:
      physics.data.qacc_warmstart[:] = warm_start
      if is_dirty:
        physics.mark_as_dirty()

  def _run(
      self, queries: np.ndarray, controls: np.ndarray
  ) -> control_step.Outcome:
    """Runs a control step as Composer does, with an error of the reward kept.

    Composer's own `step` would raise the error, which could reach the agent.
    """
    task, physics, hooks = self._task, self._physics_proxy, self._phase_hooks
    random_state, updater = self._random_state, self._observation_updater
    if hooks is not None:
      hooks.take(
          self._schedule,
          queries,
          self._observation_for_providers(),
          self._keys,
          self._states,
      )
    self._hooks.before_step(physics, controls, random_state)
    updater.prepare_for_next_control_step()
    for i in range(self._n_sub_steps):
      if i:
        updater.update()
      if hooks is not None:
        hooks.run_phases(physics)
      self._substep(controls)
    self._hooks.after_step(physics, random_state)
    updater.update()
    reward, failure = hosts.true_reward(task, physics, float)
    ending = hosts.Ending(
        reward,
        failure,
        float(task.get_discount(physics)),
        bool(task.should_terminate_episode(physics)),
    )
    return control_step.Outcome(
        [] if hooks is None else hooks.records,
        ending,
        self._states if hooks is None else hooks.states,
        self._phases.end_step(self._physics, reward),
    )

  def _sensed(self) -> tuple[dict[str, specs.Array], observing.Sense]:
    updater = self._observation_updater

    def sense(physics: Any, names: Collection[str]) -> dict[str, np.ndarray]:
      del physics  # The updater has read it already.
      observation = updater.get_observation()
      return {n: np.array(observation[n]) for n in names if n in observation}

    return dict(updater.observation_spec()), sense

  def _make_observation_updater(self) -> composer_observation.Updater:
    """Returns an updater of the selected observables.

    Observables that are not selected are not computed.

    Raises:
      SpecError: If a selected name is not that of an enabled observable.
    """
    selected = {
        name: observable
        for name, observable in self._task.observables.items()
        if observable.enabled and not isinstance(observable, meters.Unseen)
    }
    senses = self._selected_senses
    if senses is not None:
      observing.refuse_unknown(senses, [*selected, observing.TIME_LEFT])
      wanted = {*senses, *self._mechanism.own_senses}
      selected = {n: one for n, one in selected.items() if n in wanted}
    return composer_observation.Updater(
        selected,
        self._task.physics_steps_per_control_step,
        strip_singleton_buffer_dim=True,
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

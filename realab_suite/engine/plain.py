"""A task that runs a design in a plain `composer.Environment`.

Composer passes neither the action nor the observation to entities. The hooks of
a task wrapper therefore run the phases of `control_step`, at the substeps that
the schedule names. A control step ends in the hook of the mechanism, which was
attached after all other entities.
"""

from collections.abc import Callable, Mapping
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import control_step
from realab_suite.engine import environment
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import foreign
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.engine import seeding
from realab_suite.engine import session
from realab_suite.entities import state
from realab_suite.entities import views
from realab_suite.feedback import mechanisms


@final
class PlainTask(composer.Task):
  """A Composer task with feedback, for a plain `composer.Environment`.

  Time steps equal those of `environment.Environment` bit for bit, except as
  `docs/composer.md` says: the observations are `senses/<name>` and
  `registers/<name>`, and the reward is 0.0. Every episode reseeds the random
  generator of the environment.

  One environment at a time may step it.
  """

  def __init__(self, env: environment.Environment) -> None:
    """Wraps the task of an environment, which must not be used afterwards.

    Args:
      env: New environment of this package, with the task and its registers. It
        is closed.
    """
    self._task = env.task
    self._mechanism = env.mechanism
    self._codec, self._schedule = env.codec, env.schedule
    self._num_substeps = env.num_substeps
    self._senses = env.senses
    self._starts = {
        0,
        self._schedule.meter_substep,
        self._schedule.provider_substep,
    }
    self._host: hosts.Host = foreign.make_host(env.task)
    self._random_state = seeding.random_state(
        env.seed, env.world, 0, 'construction'
    )
    # The observables of this task are what it returns, so that providers
    # observe what agents do, and noise is drawn once.
    self._updater = self._make_updater()
    self._updater.reset(env.physics, self._random_state)
    self._host.start(
        env.mechanism, env.task, self._random_state, lambda: self._updater
    )
    has_parts = self._senses or env.mechanism.read_by_agent
    observer = observing.Observer(
        self._host,
        env.mechanism,
        env.max_steps,
        self._senses if has_parts else None,
    )
    self._spec = observer.spec()
    self._observables = {
        key: _Part(spec, self._observe) for key, spec in self._spec.items()
    }
    self._session = session.Session(
        env.mechanism,
        self._host,
        observer,
        env.max_steps,
        env.seed,
        env.world,
    )
    env.close()
    env.mechanism.leave_phases(_LastHooks(self))
    state.make_room(env.task.root_entity.mjcf_model)

    # Attempts to begin the episode so far; 0 once it has been initialized.
    self._num_attempts = 0
    self._is_begun = False
    self._is_observed = True
    self._view: views.View | None = None
    # The step that is running, a `control_step.ControlStep`.
    self._step: Any = None
    self._num_done = 0
    self._action = self._queries = self._controls = np.zeros(0)
    self._inputs: dict[str, np.ndarray] = {}
    self._end: events.End | None = None
    self._discount = 1.0

  @property
  def task(self) -> composer.Task:
    """The wrapped task, which returns the true reward."""
    return self._task

  @property
  def mechanism(self) -> mechanisms.FeedbackMechanism:
    """Registers, meters and providers."""
    return self._mechanism

  def add_sink(self, sink: events.EventSink) -> None:
    """Notifies a sink of all episodes that begin from now on."""
    self._session.add_sink(sink)

  # The interface of a Composer task.

  @property
  def root_entity(self) -> composer.Entity:
    return self._task.root_entity

  @property
  def observables(self) -> Mapping[str, observable.Observable]:
    """Senses and readings, as in `environment.Environment`; no others."""
    return self._observables

  @property
  def control_timestep(self) -> float:
    return self._task.control_timestep

  @property
  def physics_timestep(self) -> float:
    return self._task.physics_timestep

  @property
  def physics_steps_per_control_step(self) -> int:
    return self._num_substeps

  def action_spec(self, physics: Any) -> specs.Array:
    del physics  # The codec knows the actuators.
    return self._codec.spec

  def get_reward_spec(self) -> specs.BoundedArray:
    return specs.BoundedArray((), np.float64, 0.0, 0.0, name='reward')

  def get_discount_spec(self) -> specs.BoundedArray:
    return specs.BoundedArray((), np.float64, 0.0, 1.0, name='discount')

  def initialize_episode_mjcf(self, random_state: Any) -> None:
    self._begin_attempt(random_state)
    self._task.initialize_episode_mjcf(random_state)

  def after_compile(self, physics: Any, random_state: Any) -> None:
    """Prepares the observables of a newly compiled model.

    Raises:
      SpecError: If the environment has `legacy_step=False` and the task is a
        foreign task.
    """
    if self._host.LEGACY_STEP and not physics.legacy_step:
      raise errors.SpecError(
          f'legacy_step: False; allowed for {type(self._task).__name__} is'
          ' True, as in suite.embed'
      )
    own = self._session
    if own.episode < 0:
      seeding.reseed(random_state, own.seed, own.world, 0, 'construction')
    self._task.after_compile(physics, random_state)
    self._random_state = random_state
    self._view = views.View(physics)

  def after_compile_of_all(self, physics: Any, random_state: Any) -> None:
    """Prepares the observables, after the hooks of all entities."""
    self._updater = self._make_updater()
    self._updater.reset(physics, random_state)
    self._is_observed = True
    self._session.observation = {
        key: np.zeros(spec.shape, spec.dtype)
        for key, spec in self._spec.items()
    }

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    if not self._is_begun:
      self._begin_attempt(random_state)
    self._is_begun = False
    self._task.initialize_episode(physics, random_state)
    self._num_attempts = 0
    self._random_state = random_state
    self._session.restart_providers()
    self._is_observed = False

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    """Checks an action and passes its controls to the task.

    Raises:
      ActionError: If the action violates `action_spec`. Nothing has changed.
      EpisodeError: If the last step failed.
    """
    queries, controls = self._codec.decode(action)
    if self._step is not None or not self._session.is_open:
      raise errors.EpisodeError(
          'step: the last step or reset failed; call reset'
      )
    self._action = np.array(action)
    self._queries, self._controls = queries, controls
    self._step = control_step.ControlStep(
        physics, self._host, self._mechanism, self._view
    )
    self._num_done = 0
    with self._session.ending_on_failure():
      self._inputs = self._session.inputs(physics)
    self._task.before_step(physics, controls, random_state)

  def before_substep(
      self, physics: Any, action: Any, random_state: Any
  ) -> None:
    """Runs the phases of the control step that precede this substep."""
    del action  # Contains the queries as well.
    with self._session.ending_on_failure():
      self._run_phases(physics)
    self._task.before_substep(physics, self._controls, random_state)

  def after_substep(self, physics: Any, random_state: Any) -> None:
    self._task.after_substep(physics, random_state)
    self._num_done += 1

  def after_step(self, physics: Any, random_state: Any) -> None:
    """Passes the hook to the task; `after_step_of_all` then ends the step."""
    if not physics.legacy_step:
      views.refresh(physics)
    self._task.after_step(physics, random_state)

  def get_reward(self, physics: Any) -> float:
    """Returns 0.0. Only event sinks get the true reward."""
    del physics
    return 0.0

  def get_discount(self, physics: Any) -> float:
    del physics
    return self._discount

  def should_terminate_episode(self, physics: Any) -> bool:
    del physics
    return self._end is not None

  def _make_updater(self) -> Any:
    return self._host.make_updater(self._senses, self._mechanism.own_senses)

  def _begin_attempt(self, random_state: np.random.RandomState) -> None:
    """Begins an episode, or another attempt to begin the same episode."""
    # A step that did not end has failed, in the physics or in the task.
    own = self._session
    own.end(events.End.ABANDONED if self._step is None else events.End.ERROR)
    self._step = None
    self._is_begun = True
    attempt = self._num_attempts % episodes.MAX_RESET_ATTEMPTS
    self._num_attempts += 1
    own.episode += attempt == 0
    stream = f'reset/{attempt}'
    seeding.reseed(random_state, own.seed, own.world, own.episode, stream)

  def _run_phases(self, physics: Any) -> None:
    """Runs the phases at the present substep."""
    now, step, view = self._num_done, self._step, self._view
    if now == 0:
      self._updater.prepare_for_next_control_step()
    else:
      self._updater.update()
    if now not in self._starts or view is None:
      return
    view.open(physics)
    if now:
      self._host.latch_events(view)
    if now == 0:
      step.write_queries(self._queries)
    if now == self._schedule.meter_substep:
      step.update_meters()
    if now == self._schedule.provider_substep:
      own = self._session
      step.update_providers(self._inputs, own.keys, own.states)
    if self._mechanism.registers or not self._host.LEGACY_STEP:
      view.refresh()

  def _observe(self, physics: Any) -> Mapping[str, np.ndarray]:
    """Returns the observation.

    The first one of an episode is made here: Composer updates the derived
    quantities after the last hook of a reset.
    """
    if not self._is_observed:
      self._is_observed = True
      self._updater.reset(physics, self._random_state)
      self._session.start(physics)
      self._end = None
    return self._session.observation

  def after_step_of_all(self, physics: Any) -> None:
    """Ends a control step, after the hooks of all entities.

    Makes the observation of the step and notifies the sinks.
    """
    if self._num_done != self._num_substeps:
      self._end_early(physics)
      return
    own = self._session
    with own.ending_on_failure():
      self._updater.update()
      outcome = self._step.end()
      reads = own.observe(physics)
    self._step = None
    self._end = own.finish_step(physics, outcome, reads, self._action)
    discount = float(outcome.ending.discount)
    self._discount = episodes.discount_at(self._end, discount)

  def _end_early(self, physics: Any) -> None:
    """Ends an episode whose physics failed; the observation stays the last.

    Raises:
      SpecError: If the physics did not fail.
    """
    if not physics.data.ptr.warning.number.any():
      raise errors.SpecError(
          f'n_sub_steps: {self._num_done}; allowed is {self._num_substeps}, the'
          ' number that the task and its registers need'
      )
    self._step = None
    self._session.end(events.End.DIVERGENCE)


@final
class _LastHooks(composer.Entity):
  """Hooks that Composer calls after those of all other entities."""

  def _build(self, task: PlainTask) -> None:
    self._task = task

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._task.mechanism.mjcf_model

  def after_compile(self, physics: Any, random_state: Any) -> None:
    self._task.after_compile_of_all(physics, random_state)

  def after_step(self, physics: Any, random_state: Any) -> None:
    del random_state
    self._task.after_step_of_all(physics)


@final
class _Part(observable.Generic):
  """Part of an observation."""

  def __init__(
      self,
      spec: specs.Array,
      observe: Callable[[Any], Mapping[str, np.ndarray]],
  ) -> None:
    """Initializes the observable.

    Args:
      spec: Spec of the part, whose name is the key.
      observe: Function that returns the observation.
    """
    super().__init__(lambda physics: observe(physics)[spec.name])
    self._spec = spec
    self.enabled = True

  @property
  def array_spec(self) -> specs.Array:
    return self._spec

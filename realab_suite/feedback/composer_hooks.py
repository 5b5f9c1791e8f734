"""Hooks that run mechanisms and providers in a plain environment of Composer.

Composer calls the hooks of entities in the order of attachment and passes them
neither the action nor the agent's observation. A mechanism that is attached to
an arena therefore runs designs that need only registers and meters. The
environment of `suite.embed` passes the rest to `EmbeddedHooks`.

The phases of a mechanism run before a substep. All entities have then seen the
result of the previous one, so it does not matter whether the mechanism was
attached before or after them. A provider by itself acts at the end of a control
step, and before that lets the meters by themselves measure.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.entities import meters
from realab_suite.entities import modelled
from realab_suite.entities import registers
from realab_suite.entities import state
from realab_suite.entities import views
from realab_suite.entities.registers import ports
from realab_suite.feedback import phases as feedback_phases
from realab_suite.feedback import specs

# Measurement of the true return, which only the task's environment gets.
_SCORE = 'score'
# More substeps than any control step has.
_MANY = 10**9


class _Hooks(composer.Entity, abc.ABC):
  """Base class for the hooks of an entity with providers.

  It has the state of the current episode that is not physical: the states and
  random keys of the providers.

  Attributes:
    states: State of each provider after the last step.
  """

  def _start(
      self, owner: Any, title: str, phases: feedback_phases.Phases
  ) -> None:
    """Initializes the hooks, given the entity that they belong to."""
    self._owner = owner
    self._title = title
    self._phases = phases
    # MuJoCo's data of the world that was compiled last.
    self._data: Any = None
    # Of the current episode; the physics contains the rest of its state.
    self._episode = -1
    self._keys: Any = None
    self.states: list[Any] = []
    self._observation: dict[str, np.ndarray] = {}

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    model: mjcf.RootElement = self._owner.mjcf_model
    return model

  def initialize_episode(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del physics, random_state
    self._episode += 1
    self._keys = None
    self.states = self._phases.initial_states(())

  def _begin_step(
      self, physics: Any, random_state: np.random.RandomState, *stream: int
  ) -> None:
    """Draws random keys in the first step of an episode.

    Args:
      physics: Physics of the step.
      random_state: Generator of the task.
      *stream: Numbers that distinguish the keys from those of other hooks.

    Raises:
      SpecError: If the physics is not that of the world that was compiled last.
    """
    if self._keys is None:
      self._keys = self._draw_keys(random_state, stream)
    if physics.data.ptr is not self._data:
      raise errors.SpecError(
          f'{self._title}: the task is in two environments, and the registers'
          ' are in the one that was made last; make a task for each environment'
      )

  def _observe(self, physics: Any) -> None:
    """Reads the registers that the agent's action responds to."""
    self._observation = {
        f'registers/{read.register}': np.array(read.reading)
        for read in self._phases.read_for_agent(physics)
    }

  def _draw_keys(
      self, random_state: np.random.RandomState, stream: Sequence[int]
  ) -> np.ndarray:
    """Returns the random key of each provider, `(providers, 2)` uint64.

    The generator of the task is not advanced, so its episodes stay the same.
    """
    copy = np.random.RandomState()
    copy.set_state(random_state.get_state())
    entropy = [self._episode, *copy.randint(2**31, size=4).tolist(), *stream]
    number = len(self.states)
    words = np.random.SeedSequence(entropy).generate_state(
        2 * number, np.uint64
    )
    return words.reshape(number, 2)


class _PhaseHooks(_Hooks, abc.ABC):
  """Base class for hooks that run the phases of a mechanism.

  Attributes:
    records: Writes and reads of the current control step.
  """

  def _start(
      self, owner: Any, title: str, phases: feedback_phases.Phases
  ) -> None:
    super()._start(owner, title, phases)
    self.records: list[registers.Record] = []
    self._schedule: specs.ScheduleSpec | None = None
    self._view: Any = None
    # Substeps of the current control step so far.
    self._num_done = 0

  def after_compile(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del random_state
    self._data = physics.data.ptr
    self._view = views.View(physics)

  def before_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    self._begin_step(physics, random_state)
    self._num_done = 0
    self.records = []

  def run_phases(self, physics: Any) -> None:
    """Runs the phases that follow the substeps of a control step so far."""
    now, phases, view = self._num_done, self._phases, self._view
    meter_substep, provider_substep = self._substeps
    if now not in (meter_substep, provider_substep):
      return
    view.open(physics)
    if now == meter_substep:
      self.records += phases.update_meters(view)
    if now == provider_substep:
      log, self.states = phases.update_providers(
          view, self._observation, self._keys, self.states
      )
      self.records += log
    view.refresh()

  def after_substep(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del physics, random_state
    self._num_done += 1

  @property
  def _substeps(self) -> tuple[int, int]:
    """Substeps after which meters and providers act."""
    if self._schedule is None:
      raise errors.SpecError(
          f'{self._title} has no schedule, so it needs the number of substeps;'
          ' pass num_substeps=task.physics_steps_per_control_step to'
          ' FeedbackMechanism'
      )
    return self._schedule.meter_substep, self._schedule.provider_substep


@final
class EmbeddedHooks(_PhaseHooks):
  """Runs all phases of a mechanism, for the environment of `suite.embed`.

  The environment passes what Composer does not pass to entities, and calls
  `run_phases` before the hooks of a substep, which may write positions. It also
  ends the control step, because only it gets the true reward.
  """

  def _build(self, mechanism: Any) -> None:
    """Makes the hooks of a connected `FeedbackMechanism`."""
    title = f'design {mechanism.design.name!r}'
    self._start(mechanism, title, mechanism.phases)
    self._queries = np.zeros(0)

  def take(
      self,
      schedule: specs.ScheduleSpec,
      queries: np.ndarray,
      observation: dict[str, np.ndarray],
      keys: np.ndarray,
      states: list[Any],
  ) -> None:
    """Takes what the phases of the next control step need.

    Args:
      schedule: Substeps after which meters and providers act.
      queries: Values for the query registers, `(queries,)`.
      observation: Observation that the action responds to, with what providers
        alone sense, by name.
      keys: Random key of each provider in this episode, `(providers, 2)`.
      states: State of each provider.
    """
    self._schedule, self._queries = schedule, queries
    self._observation, self._keys, self.states = observation, keys, states

  def initialize_episode(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Does nothing, because the environment has the states of an episode."""

  def run_phases(self, physics: Any) -> None:
    """Writes the queries as well, before the first substep."""
    if not self._num_done:
      self._view.open(physics)
      self.records += self._phases.write_queries(self._view, self._queries)
      self._view.refresh()
    super().run_phases(physics)


@final
class ComposerHooks(_PhaseHooks):
  """Runs the phases of a mechanism in an environment of Composer."""

  def _build(
      self, mechanism: Any, num_substeps: int | Callable[[], int] | None
  ) -> None:
    """Makes the hooks of a mechanism.

    Args:
      mechanism: The `FeedbackMechanism`.
      num_substeps: Number of substeps in a control step, if it is known, or a
        function that returns it for the world that was compiled last.
    """
    title = f'design {mechanism.design.name!r}'
    self._start(mechanism, title, mechanism.phases)
    self._mechanism = mechanism
    self._count_substeps: Callable[[], int] | None = None
    if callable(num_substeps):
      self._count_substeps = num_substeps
    else:
      self._fit_schedule(num_substeps)
    self._is_connected = False

  def initialize_episode_mjcf(
      self, random_state: np.random.RandomState
  ) -> None:
    del random_state
    state.make_room(self.mjcf_model)

  def after_compile(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Connects the mechanism to a newly compiled world.

    Raises:
      SpecError: If the design needs what Composer does not pass to entities, or
        does not fit the world.
    """
    state.manage_room(self.mjcf_model)
    if self._count_substeps is not None:
      number = integers.check('num_substeps', self._count_substeps(), 1)
      self._fit_schedule(number)
    if not self._is_connected:
      self._connect()
      self._is_connected = True
    super().after_compile(physics, random_state)

  def before_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Reads the registers that the agent's action responds to."""
    super().before_step(physics, random_state)
    self._view.open(physics)
    self._observe(self._view)

  def before_substep(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    del random_state
    self.run_phases(physics)

  def after_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Ends the control step.

    Raises:
      SpecError: If it had another number of substeps, although the physics has
        not failed.
    """
    del random_state
    # MuJoCo's counts of warnings show a failure, which ends a step early.
    if not physics.data.ptr.warning.number.any():
      self._check_substeps()
    self._phases.end_step(physics, 0.0)

  def _fit_schedule(self, num_substeps: int | None) -> None:
    """Fits the schedule to a number of substeps, if it is known."""
    self._num_substeps = num_substeps
    design = self._mechanism.design
    if num_substeps is not None or design.schedule is not None:
      self._schedule = design.schedule_for(num_substeps or _MANY)

  def _check_substeps(self) -> None:
    """Raises a SpecError if the schedule does not fit the control step."""
    done, expected = self._num_done, self._num_substeps
    if expected is None:
      self._mechanism.design.schedule_for(done)
    elif done != expected:
      raise errors.SpecError(
          f'num_substeps: {expected}; must be {done}, as in a control step'
          ' of this environment; if the task changes it between episodes, pass'
          ' num_substeps=lambda: task.physics_steps_per_control_step'
      )

  def _connect(self) -> None:
    """Connects the meters.

    Raises:
      SpecError: If the design needs what entities of Composer do not get.
    """
    mechanism = self._mechanism
    name, _ = mechanism.design.name, self._substeps
    needs = _needs(mechanism.design)
    if not mechanism.is_connected:
      needs += [
          'the score (mechanism.connect({"score": function}) offers one)'
          for meter in mechanism.design.meters
          if meter.measures == _SCORE
      ]
    refuse(self._title, needs)
    outside = [n for n, r in mechanism.registers.items() if r.parent is None]
    if outside:
      raise errors.SpecError(
          f'design {name!r}: registers {outside} are not in the world, because'
          ' named places belong to an arena; use mechanism.attach_to(arena)'
      )
    if not mechanism.is_connected:
      mechanism.connect({})


@final
class ProviderHooks(_Hooks):
  """Lets a provider act at the end of each control step of Composer."""

  def _build(self, provider: Any, design: specs.DesignSpec) -> None:
    """Makes the hooks of a provider.

    Args:
      provider: The `FeedbackProvider`.
      design: Design of the provider alone.

    Raises:
      SpecError: If it needs what entities of Composer do not get.
    """
    refuse(provider.title, _needs(design))
    self._written = [target.register for target in provider.targets]
    read = [getattr(port, 'register', port) for port in provider.reads]
    self._used = [*dict.fromkeys([*self._written, *read])]
    all_ports = [port for one in self._used for port in ports.of(one)]
    named = {port.name: port for port in all_ports}
    if len(named) < len(all_ports):
      raise errors.SpecError(
          f'{provider.title}: two of its registers have a name in common; each'
          ' must have its own'
      )
    counters = state.Slots(provider.mjcf_model, step_count=None, score=None)
    phases = feedback_phases.Phases(design, named, counters, (), [provider])
    self._start(provider, provider.title, phases)
    # Hooks of the meters in the world that was compiled last.
    self._meters: list[meters.MeterHooks] = []

  def after_compile(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Finds the meters of a newly compiled world.

    Raises:
      SpecError: If a register of the provider is not in the world, or has
        another writer.
    """
    del random_state
    self._data = physics.data.ptr
    entities = modelled.entities_beside(self._owner)
    self._meters = [e for e in entities if isinstance(e, meters.MeterHooks)]
    writers = [
        *(e.register for e in entities if isinstance(e, meters.Meter)),
        *(
            target.register
            for e in entities
            if isinstance(e, type(self._owner)) and e is not self._owner
            for target in e.targets
        ),
    ]
    for register in self._used:
      problem = ''
      if register not in entities:
        problem = 'is not in the world; must be attached to the arena'
      elif register in self._written and register in writers:
        problem = 'has another writer in the world; must have one'
      if problem:
        raise errors.SpecError(
            f'{self._title}: register {register.name!r} {problem}'
        )

  def before_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    self._begin_step(physics, random_state, *self._title.encode())
    self._observe(physics)

  def after_step(
      self, physics: Any, random_state: np.random.RandomState
  ) -> None:
    """Lets the meters measure that have not yet, and then the provider act."""
    del random_state
    for meter in self._meters:
      meter.measure_once(physics)
    log, self.states = self._phases.update_providers(
        physics, self._observation, self._keys, self.states
    )
    self._phases.end_step(physics, 0.0)
    if log:
      # Composer steps from derived quantities, which have to be up to date.
      physics.forward()


def refuse(title: str, needs: Sequence[str]) -> None:
  """Raises a SpecError if something is needed that Composer does not pass."""
  if needs:
    needed = ', '.join(dict.fromkeys(needs))
    raise errors.SpecError(
        f'{title} needs {needed}, which entities of Composer do not get; use'
        ' suite.embed(task, design)'
    )


def needs_of(provider: Any) -> list[str]:
  """Returns the needs of a provider that Composer does not serve."""
  needs = [f'the sense {sense!r}' for sense in provider.sensed]
  if provider.action_queries or provider.action_writes:
    needs.append('the action')
  return needs


def _needs(design: specs.DesignSpec) -> list[str]:
  """Returns what a design needs that Composer does not pass to entities."""
  needs = [f'the query {name!r} of an action' for name in design.names('query')]
  if design.action_set is not None:
    needs.append('the action')
  for provider in design.providers:
    needs += needs_of(provider)
  return needs + [
      f'the end of the episode by {name!r}'
      for name, port in design.ports.items()
      if port.ends_episode is not None
  ]

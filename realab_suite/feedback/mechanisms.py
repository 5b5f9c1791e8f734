"""The feedback mechanism: runs a design inside a world.

It owns the registers and has one method for each phase of a control step that
touches them. The engine calls these methods and passes the records that they
return to event sinks.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.entities import arenas
from realab_suite.entities import axes
from realab_suite.entities import meters
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import base
from realab_suite.entities.registers import records
from realab_suite.feedback import provider_results
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs

Guard = Callable[[], contextlib.AbstractContextManager[None]]


@final
class FeedbackMechanism(composer.Entity):
  """The registers, meters and providers of a design.

  Two steps make it ready: `attach_to` puts it and its registers into a world,
  `connect` gives its meters something to measure.
  """

  def _build(self, design: specs.DesignSpec) -> None:
    """Builds the registers of a design.

    Args:
      design: The design; see `specs.load`.
    """
    self._design = design
    self._mjcf_root = mjcf.RootElement(model='feedback')
    self._step_count = state.Slot(self._mjcf_root, 'step_count')
    self._score = state.Slot(self._mjcf_root, 'score')
    self._registers = {
        name: _make_register(name, spec, design)
        for name, spec in design.registers.items()
    }
    self._queries = [self._registers[name] for name in design.names('query')]
    self._read_by_agent = design.names(*specs.READ_BY_AGENTS)
    self._meters: list[tuple[str, meters.Meter]] = []
    self._providers = [
        (f'providers[{i}]:{provider.kind}', provider)
        for i, provider in enumerate(design.providers)
    ]
    self._guard: Guard = contextlib.nullcontext

  @property
  def mjcf_model(self) -> mjcf.RootElement:
    return self._mjcf_root

  @property
  def design(self) -> specs.DesignSpec:
    return self._design

  @property
  def registers(self) -> Mapping[str, base.Register]:
    """Every register, by its name in the design."""
    return self._registers

  @property
  def queries(self) -> list[base.Register]:
    """The registers that the agent writes, in the order of its action."""
    return self._queries

  @property
  def read_by_agent(self) -> list[str]:
    """The names of the registers that the agent reads."""
    return self._read_by_agent

  def attach_to(self, root: composer.Entity) -> None:
    """Attaches the mechanism and its registers to the root entity of a task.

    Raises:
      SpecError: If the world offers no such place, or has a mechanism already.
        Nothing has been attached.
    """
    for entity in root.iter_entities():
      if isinstance(entity, FeedbackMechanism):
        raise errors.SpecError(
            f'design {self._design.name!r}: the task has the registers of'
            f' design {entity.design.name!r} already, which would stay in the'
            ' world; allowed is a task without registers: make a new one'
        )
    offered = root.places if isinstance(root, arenas.RoomArena) else {}
    places = {
        name: _find(name, spec.place, offered)
        for name, spec in self._design.registers.items()
    }
    root.attach(self)
    for name, place in places.items():
      self._registers[name].attach_to(
          root, place.position, place.yaw, place.spread
      )

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    for register in self._registers.values():
      register.detach_from_root()
    self.detach()

  def connect(
      self, measurements: Mapping[str, Callable[[Any], np.ndarray]]
  ) -> None:
    """Gives the meters their measurements.

    Args:
      measurements: What the world can measure, by name.

    Raises:
      SpecError: If a meter of the design measures something else.
    """
    for i, spec in enumerate(self._design.meters):
      if spec.measures not in measurements:
        raise errors.SpecError(
            f'design {self._design.name!r}: meters[{i}].measures:'
            f' {spec.measures!r} cannot be measured in this world; allowed are'
            f' {sorted(measurements)}'
        )
      meter = meters.Meter(
          measurements[spec.measures], self._registers[spec.writes]
      )
      self._meters.append((f'meter:{spec.measures}', meter))

  def guard_providers(self, guard: Guard) -> None:
    """Has whatever a provider does run within a context of its own.

    Args:
      guard: Makes one; what it raises counts as raised by the provider.
    """
    self._guard = guard

  def initial_writes(self, physics: protocols.Physics) -> list[records.Write]:
    """Returns the writes of the `initial` values at the last reset."""
    writes = []
    for name, register in self._registers.items():
      applied = register.applied(physics)
      step = np.zeros(np.shape(applied), int)[()]
      writes.append(
          records.Write(name, records.INITIAL, step, applied, applied)
      )
    return writes

  def write_queries(
      self, physics: protocols.Physics, values: np.ndarray
  ) -> list[records.Write]:
    """Writes the agent's queries K_t, shape `(..., queries)`."""
    if not self._queries:
      return []
    step = self._this_step(physics)
    writes = []
    for i, register in enumerate(self.queries):
      requested = axes.component(values, i)
      applied = register.write(physics, requested)
      writes.append(
          records.Write(register.name, records.AGENT, step, requested, applied)
      )
    return writes

  def update_meters(
      self, physics: protocols.Physics, idle: np.ndarray | None = None
  ) -> list[records.Write]:
    """Measures with every meter and writes the meter registers.

    Args:
      physics: One world, or many.
      idle: Worlds without anything to measure, `(...)`, bool; their registers
        keep their values.

    Raises:
      RegisterValueError: If a register cannot store a measurement. The message
        does not contain the measurement, because it may reach an agent.
    """
    if not self._meters:
      return []
    step = self._this_step(physics)
    writes = []
    for writer, meter in self._meters:
      name = meter.register.name
      try:
        measured, applied = meter.update(physics, idle)
      except errors.RegisterValueError as error:
        raise errors.RegisterValueError(
            f'{_where(writer, step, error.world)}: register {name!r} cannot'
            ' store what was measured',
            error.world,
        ) from error
      writes.append(records.Write(name, writer, step, measured, applied))
    return writes

  def initial_states(self, batch_shape: tuple[int, ...]) -> list[Any]:
    """Returns the states of the providers before an episode.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or if a state
        for many worlds is not made of arrays with an axis of worlds.
    """
    states = []
    for writer, provider in self._providers:
      where = f'{writer}, before the first step'
      try:
        with self._guard():
          state = provider.initial_state(batch_shape)
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{where}: {type(error).__name__}: {error}'
        ) from error
      if batch_shape:
        provider_results.check_state(where, state, batch_shape)
      states.append(state)
    return states

  def update_providers(
      self,
      physics: protocols.Physics,
      observation: providers.Observation,
      keys: Sequence[np.ndarray] | np.ndarray,
      states: Sequence[Any],
      idle: np.ndarray | None = None,
  ) -> tuple[list[records.Record], list[Any]]:
    """Runs every provider, in the design's order: it reads, then writes.

    Args:
      physics: One world, or many.
      observation: Observation that the agent's action responds to.
      keys: A random key per provider, each `(..., 2)`, uint64.
      states: The state of each provider.
      idle: Worlds in which the writes of providers are left out, `(...)`, bool.

    Returns:
      The reads and writes, in order, and the next states.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or a provider
        returns something else than it declared, or something of another shape.
      RegisterValueError: If a register cannot store a value.
    """
    step = self._this_step(physics)
    is_start = np.asarray(step == 1)
    log: list[records.Record] = []
    next_states = []
    for i, (writer, provider) in enumerate(self._providers):
      reads = [
          self._registers[name].inspect(physics, writer, step)
          for name in provider.reads
      ]
      readings = {read.register: np.array(read.reading) for read in reads}
      try:
        with self._guard():
          returned = provider.step(
              observation, readings, is_start, keys[i], states[i]
          )
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{_where(writer, step)}: {type(error).__name__}: {error}'
        ) from error
      try:
        values, next_state = provider_results.checked(
            provider, returned, np.shape(step)
        )
      except errors.FeedbackProviderError as error:
        raise errors.FeedbackProviderError(
            f'{_where(writer, step)} {error}'
        ) from error
      log += reads
      for name in provider.writes:
        register, value = self._registers[name], values[name]
        if idle is not None:
          value = np.where(idle, register.keep(physics), value)
        try:
          applied = register.write(physics, value)
        except errors.RegisterValueError as error:
          raise errors.RegisterValueError(
              f'{_where(writer, step, error.world)}: {error}', error.world
          ) from error
        log.append(records.Write(name, writer, step, value, applied))
      next_states.append(next_state)
    return log, next_states

  def restart_states(
      self, states: Sequence[Any], worlds: np.ndarray, num_envs: int
  ) -> list[Any]:
    """Returns the states of providers with some worlds of a batch restarted.

    Args:
      states: The state of each provider.
      worlds: Places of the worlds that begin an episode.
      num_envs: Number of worlds in the batch.

    Raises:
      FeedbackProviderError: If a state no longer has the structure of the
        initial one.
    """
    return [
        provider_results.restarted(f'state of {writer}', state, initial, worlds)
        for (writer, _), state, initial in zip(
            self._providers,
            states,
            self.initial_states((num_envs,)),
            strict=True,
        )
    ]

  def read_for_agent(self, physics: protocols.Physics) -> list[records.Read]:
    """Reads the registers that the agent may read: the observed feedback."""
    step = self._whole_steps(physics)
    return [
        self._registers[name].inspect(physics, records.AGENT, step)
        for name in self._read_by_agent
    ]

  def end_step(self, physics: protocols.Physics, reward: Any) -> None:
    """Adds one to the count of control steps and `reward` to the score."""
    self._step_count.set(physics, self._step_count.get(physics) + 1)
    self._score.set(physics, self._score.get(physics) + reward)

  def step_count(self, physics: protocols.Physics) -> np.ndarray:
    """Returns how many control steps the episode has had, `(...)`."""
    return self._step_count.copy(physics)

  def score(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true return up to the last control step, `(...)`.

    It is what a meter measures in a world that keeps no score of its own.
    """
    return self._score.copy(physics)

  def _whole_steps(self, physics: protocols.Physics) -> Any:
    """Returns the number of control steps so far, `(...)`, int."""
    return self._step_count.get(physics).astype(int)

  def _this_step(self, physics: protocols.Physics) -> Any:
    """Returns the number of the control step that is running, from 1 on."""
    return self._whole_steps(physics) + 1


def _make_register(
    name: str, spec: specs.RegisterSpec, design: specs.DesignSpec
) -> base.Register:
  kind = register_kinds.REGISTER_KINDS.get(spec.kind)
  common = dict(
      value_range=spec.range,
      scale=spec.scale,
      initial=spec.initial,
      role=spec.role,
      channel=design.channel_of(name),
      dof=spec.dof or design.dof,
      on_overflow=spec.on_overflow,
      block_size=spec.block_size,
      mass=spec.mass,
  )
  place = messages.Location(f'design {design.name!r}', ('registers', name))
  try:
    return kind(name, **common, **spec.options)
  except errors.SpecError as error:
    raise place.error(str(error)) from error
  except Exception as error:  # It may be of any class.
    raise place.error(f'{type(error).__name__}: {error}') from error


def _find(
    name: str,
    place: str | specs.PlaceSpec,
    offered: Mapping[str, arenas.Place],
) -> arenas.Place:
  if isinstance(place, specs.PlaceSpec):
    return arenas.Place(place.position, place.yaw, place.spread)
  if place not in offered:
    raise errors.SpecError(
        f'registers.{name}.place: this world offers no place {place!r}; allowed'
        f' are {sorted(offered) or "coordinates"}'
    )
  return offered[place]


def _where(writer: str, step: Any, world: int | None = None) -> str:
  """Names a writer, and the control step and the world that it failed in.

  Args:
    writer: Name of the writer.
    step: Control step of each world, `(...)`.
    world: Place of the world that failed; `None` for one world, and where the
      writer failed for all worlds of a batch at once.
  """
  if not np.ndim(step):
    return f'{writer} at step {step}'
  if world is not None:
    return f'{writer} at step {step[world]} of world {world}'
  first, last = np.min(step), np.max(step)
  steps = f'step {first}' if first == last else f'steps {first} to {last}'
  return f'{writer} at {steps} of {len(step)} worlds'

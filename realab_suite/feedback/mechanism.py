"""The feedback mechanism: what runs a design inside a world.

It owns the registers, and has one method for each thing that happens to them in
a control step. When these are called is the engine's business; who hears of it
is too: every method returns a record of what it wrote or read.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import inspect
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import mjcf
import numpy as np

from realab_suite import errors
from realab_suite.entities import arenas
from realab_suite.entities import meters
from realab_suite.entities import registers as register_entities
from realab_suite.entities import state
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs

# Who writes and reads, where it is not a provider.
AGENT = 'agent'
INITIAL = 'initial'

Guard = Callable[[], contextlib.AbstractContextManager[None]]


@final
class Write(NamedTuple):
  """A value on its way into a register.

  Attributes:
    register: The name of the register.
    writer: `agent` for a query, `initial` at a reset, a meter or a provider.
    requested: What was to be written, `(...)`.
    applied: What was written: `requested` within the register's range, `(...)`.
  """

  register: str
  writer: str
  requested: np.ndarray
  applied: np.ndarray


@final
class Read(NamedTuple):
  """A value that came out of a register, and what had become of it.

  Attributes:
    register: The name of the register.
    reader: `agent` or a provider.
    reading: What was read, `(...)`.
    permanent: The part of the corruption that the next write leaves, `(...)`.
    temporary: The part that the next write mends, `(...)`.
  """

  register: str
  reader: str
  reading: np.ndarray
  permanent: np.ndarray
  temporary: np.ndarray


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
  def registers(self) -> Mapping[str, register_entities.Register]:
    """Every register, by its name in the design."""
    return self._registers

  @property
  def queries(self) -> list[register_entities.Register]:
    """The registers that the agent writes, in the order of its action."""
    return self._queries

  @property
  def read_by_agent(self) -> list[str]:
    """The names of the registers that the agent reads."""
    return self._read_by_agent

  def attach_to(self, root: composer.Entity) -> None:
    """Attaches the mechanism and its registers to the root entity of a task.

    Raises:
      SpecError: If the world offers no such place.
    """
    root.attach(self)
    offered = root.places if isinstance(root, arenas.RoomArena) else {}
    for name, register in self._registers.items():
      place = _find(name, self._design.registers[name].place, offered)
      register.attach_to(root, place.position, place.yaw)

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

  def initial_writes(self, physics: Any) -> list[Write]:
    """Returns what registers wrote themselves when the episode began."""
    writes = []
    for name, register in self._registers.items():
      applied = register.applied(physics)
      writes.append(Write(name, INITIAL, applied, applied))
    return writes

  def write_queries(self, physics: Any, values: np.ndarray) -> list[Write]:
    """Writes the agent's queries K_t, shape `(..., queries)`."""
    writes = []
    for i, register in enumerate(self.queries):
      requested = np.array(values[..., i])
      applied = register.write(physics, requested)
      writes.append(Write(register.name, AGENT, requested, applied))
    return writes

  def update_meters(
      self, physics: Any, idle: np.ndarray | None = None
  ) -> list[Write]:
    """Lets every meter measure and write.

    Args:
      physics: One world, or many.
      idle: In which worlds there is nothing to measure, `(...)`, bool: their
        registers keep their values.
    """
    writes = []
    for writer, meter in self._meters:
      try:
        measured, applied = meter.update(physics, idle)
      except errors.RegisterValueError as error:
        step = self._step_count.get(physics)
        # The message may reach an agent, which is not to learn what is true.
        raise errors.RegisterValueError(
            f'{_where(writer, step)}: register {meter.register.name!r} cannot'
            ' store what was measured'
        ) from error
      writes.append(Write(meter.register.name, writer, measured, applied))
    return writes

  def initial_states(self, batch_shape: tuple[int, ...]) -> list[Any]:
    """Returns the states of the providers before an episode.

    Raises:
      FeedbackProviderError: If a provider or its guard raises.
    """
    states = []
    for writer, provider in self._providers:
      try:
        with self._guard():
          states.append(provider.initial_state(batch_shape))
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{writer}, before the first step: {type(error).__name__}: {error}'
        ) from error
    return states

  def update_providers(
      self,
      physics: Any,
      observation: providers.Observation,
      keys: Sequence[np.ndarray],
      states: Sequence[Any],
      idle: np.ndarray | None = None,
  ) -> tuple[list[Write | Read], list[Any]]:
    """Lets every provider read, think and write, in the design's order.

    Args:
      physics: One world, or many.
      observation: What the agent saw when it chose its action.
      keys: A random key per provider, each `(..., 2)`, uint64.
      states: The state of each provider.
      idle: In which worlds what providers say does not count, `(...)`, bool.

    Returns:
      What was read and written, in order, and the next states.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or a provider
        writes something else than it declared, or something of another shape.
      RegisterValueError: If a register cannot store what a provider wrote.
    """
    step = self._step_count.get(physics)
    records: list[Write | Read] = []
    next_states = []
    for i, (writer, provider) in enumerate(self._providers):
      seen = [self._read(physics, name, writer) for name in provider.reads]
      readings = {read.register: np.array(read.reading) for read in seen}
      try:
        with self._guard():
          values, next_state = provider.step(
              observation, readings, np.asarray(step == 0), keys[i], states[i]
          )
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{_where(writer, step)}: {type(error).__name__}: {error}'
        ) from error
      values = _checked_writes(writer, step, provider, values)
      records += seen
      for name in provider.writes:
        register, value = self._registers[name], values[name]
        if idle is not None:
          value = np.where(idle, register.keep(physics), value)
        try:
          applied = register.write(physics, value)
        except errors.RegisterValueError as error:
          raise errors.RegisterValueError(
              f'{_where(writer, step)}: {error}'
          ) from error
        records.append(Write(name, writer, value, applied))
      next_states.append(next_state)
    return records, next_states

  def read_for_agent(self, physics: Any) -> list[Read]:
    """Reads the registers that the agent may read: the observed feedback."""
    return [self._read(physics, name, AGENT) for name in self._read_by_agent]

  def shadow_reads(self, physics: Any, reader: str) -> list[Read]:
    """Reads every register on behalf of an evaluator; moves nothing."""
    return [self._read(physics, name, reader) for name in self._registers]

  def end_step(self, physics: Any, reward: Any) -> None:
    """Counts the control step and its true reward."""
    self._step_count.set(physics, self._step_count.get(physics) + 1)
    self._score.set(physics, self._score.get(physics) + reward)

  def step_count(self, physics: Any) -> np.ndarray:
    """Returns how many control steps the episode has had, `(...)`."""
    return self._step_count.copy(physics)

  def score(self, physics: Any) -> np.ndarray:
    """Returns the true return up to the last control step, `(...)`.

    It is what a meter measures in a world that keeps no score of its own.
    """
    return self._score.copy(physics)

  def _read(self, physics: Any, name: str, reader: str) -> Read:
    return Read(name, reader, *self._registers[name].inspect(physics))


def _make_register(
    name: str, spec: specs.RegisterSpec, design: specs.DesignSpec
) -> register_entities.Register:
  spread = (
      spec.place.spread
      if isinstance(spec.place, specs.PlaceSpec)
      else (0.0, 0.0)
  )
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
      spread=spread,
  )
  for option in spec.options:
    if (
        option in common
        or option not in inspect.signature(kind._build).parameters
    ):
      raise errors.SpecError(
          f'design {design.name!r}: registers.{name}.options: {option!r} is no'
          f' option of a {spec.kind} register'
      )
  return kind(name, **common, **spec.options)


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


def _checked_writes(
    writer: str, step: np.ndarray, provider: providers.Provider, values: Any
) -> dict[str, np.ndarray]:
  """Returns what a provider wrote, if it is what it declares."""
  if not isinstance(values, Mapping) or values.keys() != set(provider.writes):
    given = sorted(map(str, values)) if isinstance(values, Mapping) else values
    raise errors.FeedbackProviderError(
        f'{_where(writer, step)} returned {given!r:.80}; it declares writes to'
        f' {sorted(provider.writes)}'
    )
  checked = {}
  for name, value in values.items():
    try:
      number = np.asarray(value)
    except Exception as error:  # It may be of any class, or none.
      raise errors.FeedbackProviderError(
          f'{_where(writer, step)} wrote {value!r:.80} to {name!r}: {error}'
      ) from error
    if number.dtype.kind not in 'iuf':
      raise errors.FeedbackProviderError(
          f'{_where(writer, step)} wrote {value!r:.80} to {name!r}; expected'
          ' numbers'
      )
    if number.shape != step.shape:
      raise errors.FeedbackProviderError(
          f'{_where(writer, step)} wrote shape {number.shape} to {name!r};'
          f' expected {step.shape}'
      )
    checked[name] = number.astype(np.float64)
  return checked


def _where(writer: str, step: np.ndarray) -> str:
  """Names a writer and the control step that it failed in, of world 0."""
  return f'{writer} at step {int(np.ravel(step)[0])}'

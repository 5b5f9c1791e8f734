"""The feedback mechanism, which runs a design in a world.

It owns the registers and has one method for each phase of a control step that
reads or writes them. The engine calls these methods and passes the returned
records to event sinks. In an environment of Composer, the mechanism calls them
itself, from Composer's hooks; see `composer_hooks`.
"""

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import copy
import itertools
from typing import Any, NamedTuple, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages
from realab_suite.entities import arenas
from realab_suite.entities import axes
from realab_suite.entities import measurables
from realab_suite.entities import meters
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import base
from realab_suite.entities.registers import ports
from realab_suite.entities.registers import records
from realab_suite.feedback import assembly
from realab_suite.feedback import clean_contents
from realab_suite.feedback import composer_hooks
from realab_suite.feedback import measurements
from realab_suite.feedback import provider_entities
from realab_suite.feedback import provider_results
from realab_suite.feedback import providers
from realab_suite.feedback import specs
from realab_suite.policies import random_keys

# Inside the mechanism, `ports` is the name of a property.
_Port = ports.AnyPort

Guard = clean_contents.Guard

IDEAL = 'ideal/'
"""Prefix of keys of ideal measurements of what providers sense."""


@final
class _Sight(NamedTuple):
  """Readings in the observation of a control step.

  Attributes:
    seen: Arguments of `clean_contents.is_disturbed` of each reading, by key.
    is_disturbed: True where a reading differs from them, `(...)` bool.
  """

  seen: dict[str, tuple[Any, Any, Any, float]]
  is_disturbed: Any


_Target = provider_entities.Target


@final
class FeedbackMechanism(modelled.ModelledEntity):
  """The registers, meters and providers of a design.

  `arena.attach(mechanism)` attaches them to the arena of any task; an
  environment of Composer then runs the design (docs/doors.md). `attach_to`
  does the same for designs with named places. `connect`
  connects the meters to functions of the task.

  An environment of this package calls `leave_phases`, and then the methods for
  the phases of a control step.
  """

  def _build(
      self, design: specs.DesignSpec, num_substeps: int | None = None
  ) -> None:
    """Builds the registers of a design.

    Args:
      design: The design; see `specs.load`.
      num_substeps: Number of physics substeps in a control step of the task.
        Composer does not pass it to entities, so an environment of Composer
        needs it for designs without a `schedule`.

    Raises:
      SpecError: If `design` is no `DesignSpec`, if `num_substeps` is not a
        positive integer or `None`, or if a register kind refuses its arguments.
    """
    if not isinstance(design, specs.DesignSpec):
      raise errors.SpecError(
          f'design: {messages.quote(design)}; allowed is a DesignSpec, as from'
          ' specs.load(name_or_file_or_dict)'
      )
    if num_substeps is not None:
      num_substeps = integers.check('num_substeps', num_substeps, 1)
    self._design = design
    self._mjcf_root = mjcf.RootElement(model='feedback')
    self._step_count = state.Slot(self._mjcf_root, 'step_count')
    self._score = state.Slot(self._mjcf_root, 'score')
    self._registers = {
        name: assembly.make_register(name, spec, design)
        for name, spec in design.registers.items()
    }
    self._ports: dict[str, _Port] = {
        port.name: port
        for register in self._registers.values()
        for port in ports.of(register)
    }
    self._tolerances = {
        name: clean_contents.tolerance(spec.scale, spec.range)
        for name, spec in design.ports.items()
    }
    queries = design.names('query')
    self._queries = [self._ports[name] for name in queries]
    self._query_targets = self._targets(queries)
    self._read_by_agent = design.names(*specs.READ_BY_AGENTS)
    self._meters: list[tuple[tuple[str, ...], meters.Meter, _Target]] = []
    self._is_connected = False
    self._instruments: set[str] = set()
    self._asked: list[measurements.AskedRegisters] = []
    self._providers = [
        provider_entities.FeedbackProvider(
            f'providers[{i}]:{spec.kind}',
            spec,
            self._mjcf_root,
            [self._ports[name] for name in spec.reads],
            self._targets(spec.writes),
            self._read_by_agent,
        )
        for i, spec in enumerate(design.providers)
    ]
    self._guard: Guard = contextlib.nullcontext
    self._hooks: composer.Entity | None = composer_hooks.ComposerHooks(
        self, num_substeps
    )
    for name, register in self._registers.items():
      place = assembly.own_place(design, name)
      if place is not None:
        assembly.attach(register, self, place)

  def _build_observables(self) -> composer.Observables:
    """Returns the readings of registers that agents read, by port.

    They are enabled where Composer's hooks run the mechanism, and disabled
    where an environment of this package makes the observations.
    """
    observables = super()._build_observables()
    for name in self._read_by_agent:
      reading = observable.Generic(self._ports[name].read)
      observables.add_observable(name, reading, enabled=False)
    return observables

  def iter_entities(
      self, exclude_self: bool = False
  ) -> Iterator[composer.Entity]:
    """Returns the mechanism and its parts that are in the world.

    The hooks for Composer come last, after those of the registers.
    """
    meters = [meter for _, meter, _ in self._meters]
    hooks = [] if self._hooks is None else [self._hooks]
    registers = super().iter_entities(exclude_self)
    return itertools.chain(registers, meters, self._providers, hooks)

  def leave_phases(self) -> None:
    """Leaves the phases of control steps to the caller."""
    self._hooks = None

  @property
  def design(self) -> specs.DesignSpec:
    """Design that the mechanism runs."""
    return self._design

  @property
  def registers(self) -> Mapping[str, base.Register]:
    """Registers, by their names in the design."""
    return self._registers

  @property
  def ports(self) -> Mapping[str, _Port]:
    """Ports of the registers, by their names in the design."""
    return self._ports

  @property
  def queries(self) -> list[_Port]:
    """Ports that the agent writes, in the order of its action."""
    return self._queries

  @property
  def is_connected(self) -> bool:
    """True after `connect`."""
    return self._is_connected

  @property
  def measured(self) -> list[list[str]]:
    """Names of the registers whose blocks each meter measures, if any."""
    return [sorted(one.asked) for one in self._asked]

  @property
  def obstructible(self) -> list[str]:
    """Names of the ports that depend on a `meters.Instrument`.

    A meter writes them, or a provider that senses through it.
    """
    return [
        name
        for _, meter, target in self._meters
        if meter.can_be_obstructed
        for name in target.names
    ] + [
        name
        for provider in self._providers
        if self._instruments & {*provider.seen} and not provider.is_secure
        for name in provider.spec.writes
    ]

  @property
  def own_senses(self) -> set[str]:
    """Names of the senses that providers have, whatever the agent has."""
    own = [p for p in self._design.providers if p.senses == providers.OWN]
    return {name for provider in own for name in provider.sensed}

  @property
  def read_by_agent(self) -> list[str]:
    """Names of the ports that the agent reads."""
    return self._read_by_agent

  def _targets(self, names: Sequence[str]) -> list[_Target]:
    """Returns the writes that set the ports of these names, in their order."""
    found: dict[str, _Target] = {}
    for name in names:
      register = self._design.register_of(name)
      if register not in found:
        own = self._design.ports_by_register[register]
        found[register] = _Target(
            self._registers[register],
            [self._ports[one] for one in own],
            own,
            [names.index(one) for one in own],
        )
    return [*found.values()]

  def attach_to(self, root: composer.Entity) -> None:
    """Attaches the mechanism and its registers to the root entity of a task.

    Args:
      root: Root entity of the task, usually its arena.

    Raises:
      SpecError: If the world has no place of a name in the design, a register
        cannot be at its place, or the world has a mechanism already. Nothing is
        attached.
    """
    for entity in root.iter_entities():
      if isinstance(entity, FeedbackMechanism):
        raise errors.SpecError(
            f'design {self._design.name!r}: the task already contains the'
            f' registers of design {entity.design.name!r}, which would stay in'
            ' the world; allowed is a task without registers: make a new one'
        )
    named_places = root.places if isinstance(root, arenas.RoomArena) else {}
    places = {
        name: assembly.find_place(name, spec.place, named_places)
        for name, spec in self._design.registers.items()
    }
    for name, place in places.items():
      if place.block is not None:
        self._registers[name].check_can_use_a_block()
    for register in self._registers.values():
      if register.parent is not None:
        register.detach_from_root()
    root.attach(self)
    for name, place in places.items():
      assembly.attach(self._registers[name], root, place)

  def detach_from_root(self) -> None:
    """Undoes `attach_to`."""
    for register in self._registers.values():
      register.detach_from_root()
    self.detach()

  def connect(
      self,
      functions: Mapping[str, measurements.Measure],
      parts: Mapping[str, measurables.Measurable] | None = None,
      privileged_senses: Mapping[str, measurements.Measure] | None = None,
  ) -> None:
    """Connects the meters to a world.

    Args:
      functions: Functions of the physics that meters can measure, by name.
      parts: Parts of the world that meters can measure, by name. `None` for
        those that its entities declare, and all bodies by their full MJCF
        identifiers, except the blocks of registers.
      privileged_senses: Functions of the physics that providers can sense, by
        name.

    Raises:
      SpecError: If a meter of the design measures, or a register begins with,
        anything else.
    """
    if parts is None:
      parts = assembly.parts_beside(self)
    self._instruments = {
        f'privileged/{name}'
        for name, function in (privileged_senses or {}).items()
        if isinstance(function, meters.Instrument)
    }
    for name, register in self._registers.items():
      initial = self._design.registers[name].initial
      if isinstance(initial, str):
        # The same for all ports, or one for each.
        of_ports = [f'{initial}_{port}' for port in register.PORTS]
        if of_ports and initial not in functions:
          names = of_ports
        else:
          names = [initial]
        if any(name not in functions for name in names):
          raise errors.SpecError(
              f'design {self._design.name!r}: registers.{name}.initial: this'
              f' world does not offer {initial!r}'
              f'{messages.did_you_mean(initial, functions)}; allowed are'
              f' numbers and {sorted(functions)}'
          )
        values = [functions[name] for name in names]
        register.start_with(_stacked(values) if register.PORTS else values[0])
    found: dict[str, tuple[str, measurements.Measure]] = {}
    for i, spec in enumerate(self._design.meters):
      asked = measurements.AskedRegisters(self._registers)
      world = measurements.World(
          messages.Location(
              f'design {self._design.name!r}', ('meters', i, 'measures')
          ),
          functions,
          parts,
          asked,
      )
      self._asked.append(asked)
      title, measure = measurements.connect(spec.measures, world)
      asked.close()
      found[spec.writes] = f'meter:{title}', measure
    for target in self._targets([*found]):
      writers, measures = zip(*map(found.get, target.names), strict=True)
      meter = meters.Meter(_joint(measures), target.register, self._mjcf_root)
      self._meters.append((writers, meter, target))
    self._is_connected = True

  def guard_providers(self, guard: Guard) -> None:
    """Sets the context manager in which each call of a provider runs.

    Args:
      guard: Function that returns a new context manager. An exception from the
        context manager counts as an exception from the provider.
    """
    self._guard = guard

  def initial_writes(self, physics: protocols.Physics) -> list[records.Write]:
    """Returns the records of the writes of `initial` at the last reset."""
    writes = []
    for name, register in self._ports.items():
      applied = register.applied(physics)
      step = np.zeros(np.shape(applied), int)[()]
      writes.append(
          records.Write(
              name,
              records.INITIAL,
              step,
              applied,
              applied,
              register.obstruction(physics),
              register.clean(physics),
          )
      )
    return writes

  def write_queries(
      self, physics: protocols.Physics, values: np.ndarray
  ) -> list[records.Write]:
    """Writes the agent's queries K_t to the query registers.

    Args:
      physics: One world or a batch of worlds.
      values: Queries, `(..., queries)`, in the order of `queries`.

    Returns:
      Records of the writes, in the order of `queries`.

    Raises:
      RegisterValueError: If a register cannot store a query.
    """
    if not self._queries:
      return []
    step = self._whole_steps(physics) + 1
    writes = []
    for target in self._query_targets:
      if target.register.PORTS:
        requested = values[..., target.columns]
      else:
        requested = values[..., target.columns[0]][()]
      writers = (records.AGENT,) * len(target.ports)
      writes += _write(physics, target, writers, step, requested)
    return writes

  def update_meters(
      self, physics: protocols.Physics, where: axes.Mask = None
  ) -> list[records.Write]:
    """Measures with every meter, then writes the meter registers.

    A write moves blocks, which other meters may measure. All meters therefore
    measure first.

    Args:
      physics: One world or a batch of worlds.
      where: Worlds whose registers are written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Records of the writes, in the design's order.

    Raises:
      RegisterValueError: If a register cannot store a measurement. The message
        does not contain the measurement, because it may reach an agent.
    """
    if not self._meters:
      return []
    step = self._whole_steps(physics) + 1
    where = axes.both(where, None)
    values = [
        (meter.measure(physics), meter.ideal(physics))
        for _, meter, _ in self._meters
    ]
    writes = []
    for one, (measured, ideal) in zip(self._meters, values, strict=True):
      writers, _, target = one
      try:
        some = _write(physics, target, writers, step, measured, where)
      except errors.RegisterValueError as error:
        writer = ' and '.join(writers)
        raise errors.RegisterValueError(
            f'{_where(writer, step, error.world)}: register'
            f' {target.register.name!r} cannot store the measured value',
            error.world,
        ) from error
      if ideal is not None:
        target.register.set_clean(physics, ideal, where)
        some = self._with_clean(physics, some)
      writes += some
    return writes

  def initial_states(self, batch_shape: tuple[int, ...]) -> list[Any]:
    """Returns the initial states of the providers; see `clean_contents`.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for a batch.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or if a state of
        a batch contains a leaf that is not an array with an axis of worlds.
    """
    states = []
    for one in self._providers:
      where = f'{one.title}, before the first step'
      try:
        with self._guard():
          state = one.spec.initial_state(batch_shape)
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{where}: {messages.exception(error)}'
        ) from error
      if batch_shape:
        provider_results.check_state(where, state, batch_shape)
      states.append(clean_contents.initial_state(state, batch_shape))
    return states

  def update_providers(
      self,
      physics: protocols.Physics,
      observation: providers.Observation,
      keys: np.ndarray,
      states: Sequence[Any],
      where: axes.Mask = None,
  ) -> tuple[list[records.Record], list[Any]]:
    """Runs the providers in the design's order; each reads, then writes.

    A provider with `every` is called only if it acts in some world, and keeps
    its state in the other worlds. Where what it reads is disturbed, it is
    called once more, with clean contents; see `clean_contents`.

    Args:
      physics: One world or a batch of worlds.
      observation: Observation that the agent's action responds to.
      keys: Random key of each provider in this episode, `(providers, ..., 2)`
        uint64.
      states: State of each provider.
      where: Worlds whose registers may be written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Records of the reads and writes, in order, and the next states.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or if a provider
        returns other writes than it declares, or values of a wrong shape.
      RegisterValueError: If a register cannot store a value.
    """
    before = self._whole_steps(physics)
    step = before + 1
    is_start = np.asarray(step == 1)
    keys_of_step = random_keys.of_step(keys, before)
    sight = self._sight(physics, observation)
    log: list[records.Record] = []
    next_states = []
    for i, provider in enumerate(self._providers):
      acts = provider.spec.acts_in(step)
      if axes.nowhere(acts):
        next_states.append(states[i])
        continue
      reads = [
          port.inspect(physics, provider.title, step) for port in provider.reads
      ]
      if acts is not None:
        reads = [read._replace(where=acts) for read in reads]
      ideal = {
          key: observation[IDEAL + key]
          for key in provider.seen
          if IDEAL + key in observation
      }
      seen = {key: observation[key] for key in provider.seen}
      inputs = clean_contents.Inputs(
          {**seen, **ideal} if provider.is_secure else seen,
          {read.register: read.reading for read in reads},
          is_start,
          keys_of_step[i],
      )
      values, state = self._call(i, step, inputs, states[i], acts)
      may_write = axes.both(where, acts)
      clean = self._clean_call(
          physics, i, inputs, reads, sight, ideal, states[i], state, may_write
      )
      log += reads
      log += self._write_all(physics, i, step, values, may_write, clean)
      next_states.append(state if clean is None else clean.state)
    return log, next_states

  def _sight(
      self, physics: protocols.Physics, observation: providers.Observation
  ) -> _Sight:
    """Compares the readings in an observation with the clean contents.

    Providers have not written since the observation.
    """
    seen: dict[str, tuple[Any, Any, Any, float]] = {}
    is_disturbed: Any = False
    for name in self._read_by_agent:
      register, key = self._ports[name], f'registers/{name}'
      seen[key] = (
          observation[key][()],
          register.applied(physics),
          register.clean(physics),
          self._tolerances[name],
      )
      is_disturbed = is_disturbed | clean_contents.is_disturbed(*seen[key])
    return _Sight(seen, is_disturbed)

  def _call(
      self,
      i: int,
      step: Any,
      inputs: clean_contents.Inputs,
      state: Mapping[str, Any],
      acts: axes.Mask,
  ) -> tuple[dict[str, provider_results.RequestedWrite], dict[str, Any]]:
    """Calls a provider with readings.

    Returns:
      Its writes, and its next state if its clean call gives the same.
    """
    writer, provider = self._providers[i].title, self._providers[i].spec
    before = state[clean_contents.ACTUAL]
    try:
      with self._guard():
        # A change of the state in place must not reach the clean call.
        returned = provider.step(*inputs.of_a_call(), copy.deepcopy(before))
    except Exception as error:
      raise errors.FeedbackProviderError(
          f'{_where(writer, step)}: {messages.exception(error)}'
      ) from error
    try:
      values, following = provider_results.checked(
          provider, returned, step.shape
      )
      if acts is not None:
        following = provider_results.merged('state', following, before, ~acts)
    except errors.FeedbackProviderError as error:
      raise errors.FeedbackProviderError(
          f'{_where(writer, step)} {error}'
      ) from error
    return values, clean_contents.following(state, following, acts)

  def _clean_call(
      self,
      physics: protocols.Physics,
      i: int,
      inputs: clean_contents.Inputs,
      reads: Sequence[records.Read],
      sight: _Sight,
      ideal: Mapping[str, np.ndarray],
      state: Mapping[str, Any],
      following: dict[str, Any],
      where: axes.Mask,
  ) -> clean_contents.Contents | None:
    """Calls a provider once more, with clean contents.

    It is called in the worlds in which an input or its state differs from that.

    Returns:
      Clean contents of the registers that it writes; `None` if nothing differs,
      or the provider is not repeatable.
    """
    provider = self._providers[i].spec
    if not provider.is_repeatable:
      return None
    needs = state[clean_contents.DIFFERS] | sight.is_disturbed
    for key, value in ideal.items():
      differs = np.asarray(inputs.observation[key] != value)
      own_axes = tuple(range(np.ndim(inputs.episode_start), differs.ndim))
      needs = needs | differs.any(axis=own_axes)
    seen = {}
    for read in reads:
      register = self._ports[read.register]
      applied = register.applied(physics)
      most = self._tolerances[read.register]
      seen[read.register] = read.reading, applied, read.clean, most
      needs = needs | clean_contents.is_disturbed(*seen[read.register])
    if where is not None:
      needs = needs & where
    if not axes.anywhere(needs):
      return None
    shown, readings = (
        {name: clean_contents.undisturbed(*of) for name, of in some.items()}
        for some in (sight.seen, seen)
    )
    clean = clean_contents.Inputs(
        {**inputs.observation, **shown, **ideal},
        readings,
        inputs.episode_start,
        inputs.key,
    )
    return clean_contents.call(
        provider, clean, state, following, needs, self._guard
    )

  def _write_all(
      self,
      physics: protocols.Physics,
      i: int,
      step: Any,
      values: Mapping[str, provider_results.RequestedWrite],
      where: axes.Mask,
      clean: clean_contents.Contents | None,
  ) -> list[records.Write]:
    """Writes the registers of a provider and sets their clean contents."""
    writer = self._providers[i].title
    writes = []
    for target in self._providers[i].targets:
      if target.register.PORTS:
        write = provider_results.joint(
            _where(writer, step), target.names, values
        )
      else:
        write = values.get(target.names[0])
      before = clean and [port.clean(physics) for port in target.ports]
      some: list[records.Write] = []
      if write is not None:
        mask = axes.both(write.where, where)
        if not axes.nowhere(mask):
          writers = (writer,) * len(target.ports)
          try:
            some = _write(physics, target, writers, step, write.value, mask)
          except errors.RegisterValueError as error:
            raise errors.RegisterValueError(
                f'{_where(writer, step, error.world)}: {error}', error.world
            ) from error
      if clean is not None and before is not None:
        for port, content in zip(target.ports, before, strict=True):
          clean_contents.store(physics, port, clean, content)
        some = self._with_clean(physics, some)
      writes += some
    return writes

  def _with_clean(
      self, physics: protocols.Physics, writes: Sequence[records.Write]
  ) -> list[records.Write]:
    """Returns records with the present clean contents."""
    return [
        one._replace(clean=self._ports[one.register].clean(physics))
        for one in writes
    ]

  def restart_states(
      self, states: Sequence[Any], worlds: np.ndarray, num_envs: int
  ) -> list[Any]:
    """Returns the states of the providers with some worlds restarted.

    Args:
      states: State of each provider.
      worlds: Indices of the worlds that begin an episode.
      num_envs: Number of worlds in the batch.

    Raises:
      FeedbackProviderError: If a state no longer has the structure of the
        initial one.
    """
    return [
        provider_results.merged(f'state of {one.title}', state, initial, worlds)
        for one, state, initial in zip(
            self._providers,
            states,
            self.initial_states((num_envs,)),
            strict=True,
        )
    ]

  def read_for_agent(self, physics: protocols.Physics) -> list[records.Read]:
    """Reads the registers that the agent may read.

    Args:
      physics: One world or a batch of worlds.

    Returns:
      Records of the reads, in the order of `read_by_agent`.
    """
    step = self._whole_steps(physics)
    return [
        self._ports[name].inspect(physics, records.AGENT, step)
        for name in self._read_by_agent
    ]

  def ends_episode(self, reads: Sequence[records.Read]) -> Any:
    """Returns True for worlds whose episode a signal ends, `(...)` bool.

    Args:
      reads: Reads for the agent, as from `read_for_agent`.
    """
    is_ending: Any = np.False_
    for read in reads:
      threshold = self._design.ports[read.register].ends_episode
      if threshold is not None:
        is_ending = is_ending | threshold.is_crossed(read.reading)
    return is_ending

  def end_step(self, physics: protocols.Physics, reward: Any) -> None:
    """Increments the number of control steps and adds a reward to the score.

    Args:
      physics: One world or a batch of worlds.
      reward: True reward of the control step, `(...)`.
    """
    self._step_count.set(physics, self._step_count.get(physics) + 1)
    self._score.set(physics, self._score.get(physics) + reward)

  def step_count(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the number of completed control steps of the episode, `(...)`."""
    return self._step_count.copy(physics)

  def score(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true return up to the last control step, `(...)`.

    It is the measurement `score` of tasks without a score of their own.
    """
    return self._score.copy(physics)

  def _whole_steps(self, physics: protocols.Physics) -> Any:
    """Returns the number of completed control steps, `(...)` int."""
    count = self._step_count.get(physics)
    return count.astype(int) if count.ndim else np.int64(count)


def _joint(functions: Sequence[measurements.Measure]) -> measurements.Measure:
  """Returns a function with the values of several, `(..., functions)`.

  That of a single function has no axis for it.
  """
  if len(functions) == 1:
    return functions[0]
  ideals = [
      one.ideal if isinstance(one, meters.Instrument) else one
      for one in functions
  ]
  if ideals == [*functions]:
    return _stacked(functions)
  return meters.Instrument(_stacked(functions), _stacked(ideals))


def _stacked(functions: Sequence[measurements.Measure]) -> measurements.Measure:
  return lambda physics: np.stack([one(physics) for one in functions], axis=-1)


def _write(
    physics: protocols.Physics,
    target: _Target,
    writers: Sequence[str],
    step: Any,
    value: Any,
    where: axes.Mask = None,
) -> list[records.Write]:
  """Writes a register and returns a record of the write for each port.

  Args:
    physics: One world or a batch of worlds.
    target: The register.
    writers: Name of the writer of each port, for the records.
    step: Control step, `(...)` int, for the records.
    value: Requested value, `(...)`, or `(..., ports)` for several ports.
    where: Worlds in which to write it, `(...)` bool; `None` for all worlds.

  Raises:
    RegisterValueError: If the register cannot store the value.
  """
  register = target.register
  applied = register.write(physics, value, where)
  obstruction = register.obstruction(physics)
  # What was written is clean for now.
  clean = applied if where is None else register.clean(physics)
  if not register.PORTS:
    return [
        records.Write(
            target.names[0],
            writers[0],
            step,
            value,
            applied,
            obstruction,
            clean,
            where,
        )
    ]
  return [
      records.Write(
          name,
          writers[i],
          step,
          value[..., i][()],
          applied[..., i][()],
          obstruction[..., i][()],
          clean[..., i][()],
          where,
      )
      for i, name in enumerate(target.names)
  ]


def _where(writer: str, step: Any, world: int | None = None) -> str:
  """Returns the writer, the control step and the world of a failure.

  Args:
    writer: Name of the writer.
    step: Control step of each world, `(...)`.
    world: Index of the world of the failure; `None` for one world, and for a
      failure in all worlds of a batch at once.
  """
  if not np.ndim(step):
    return f'{writer} at step {step}'
  if world is not None:
    return f'{writer} at step {step[world]} of world {world}'
  first, last = np.min(step), np.max(step)
  steps = f'step {first}' if first == last else f'steps {first} to {last}'
  return f'{writer} at {steps} in a batch of {len(step)} worlds'

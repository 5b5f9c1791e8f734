"""The feedback mechanism: a design, assembled in a world.

`phases` has the parts of a control step in which it acts.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import itertools
from typing import final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
import numpy as np

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import messages
from realab_suite.entities import arenas
from realab_suite.entities import measurables
from realab_suite.entities import meters
from realab_suite.entities import modelled
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import base
from realab_suite.entities.registers import ports
from realab_suite.feedback import assembly
from realab_suite.feedback import composer_hooks
from realab_suite.feedback import fitting
from realab_suite.feedback import measurements
from realab_suite.feedback import phases
from realab_suite.feedback import provider_entities
from realab_suite.feedback import providers
from realab_suite.feedback import register_writes
from realab_suite.feedback import specs

# Inside the mechanism, `ports` is the name of a property.
_Port = ports.AnyPort

_Target = register_writes.Target


@final
class FeedbackMechanism(modelled.ModelledEntity):
  """The registers, meters and providers of a design.

  `arena.attach(mechanism)` attaches them to the arena of any task; an
  environment of Composer then runs the design (docs/doors.md). `attach_to`
  does the same for designs with named places. `connect`
  connects the meters to functions of the task.

  An environment of this package calls `leave_phases`, and then the phases of a
  control step.
  """

  def _build(
      self,
      design: specs.DesignSpec,
      num_substeps: int | Callable[[], int] | None = None,
  ) -> None:
    """Builds the registers of a design.

    Args:
      design: The design; see `specs.load`.
      num_substeps: Number of physics substeps in a control step of the task.
        Composer does not pass it to entities, so an environment of Composer
        needs it for designs without a `schedule`. A function that returns it,
        if it differs between episodes.

    Raises:
      SpecError: If `design` is no `DesignSpec`, if `num_substeps` is not a
        positive integer or `None`, or if a register kind refuses its arguments.
    """
    if not isinstance(design, specs.DesignSpec):
      raise errors.SpecError(
          f'design: {messages.quote(design)}; must be a DesignSpec, as from'
          ' specs.load(name_or_file_or_dict)'
      )
    if num_substeps is not None and not callable(num_substeps):
      num_substeps = integers.check('num_substeps', num_substeps, 1)
    self._design = design
    self._mjcf_root = mjcf.RootElement(model='feedback')
    self._counters = state.Slots(self._mjcf_root, step_count=None, score=None)
    self._registers = {
        name: assembly.make_register(name, spec, design)
        for name, spec in design.registers.items()
    }
    self._ports: dict[str, _Port] = {
        port.name: port
        for register in self._registers.values()
        for port in ports.of(register)
    }
    queries = design.names('query')
    self._queries = [self._ports[name] for name in queries]
    self._read_by_agent = design.names(*specs.READ_BY_AGENTS)
    self._is_connected = False
    self._instruments: set[str] = set()
    self._asked: list[measurements.AskedRegisters] = []
    self._providers = [
        provider_entities.FeedbackProvider(
            spec,
            [self._ports[name] for name in spec.reads],
            [target.register for target in self._targets(spec.writes)],
            title=f'providers[{i}]:{spec.kind}',
            mjcf_model=self._mjcf_root,
            read_by_agent=self._read_by_agent,
        )
        for i, spec in enumerate(design.providers)
    ]
    self._phases = phases.Phases(
        design,
        self._ports,
        self._counters,
        self._targets(queries),
        self._providers,
    )
    self._hooks: composer.Entity | None = composer_hooks.ComposerHooks(
        self, num_substeps
    )
    for name, register in self._registers.items():
      place = design.registers[name].place
      if not isinstance(place, str):
        assembly.attach(register, self, assembly.find_place(name, place, {}))

  def _build_observables(self) -> composer.Observables:
    """Returns the readings of registers that agents read, by port.

    They are enabled until `leave_phases`, because an environment of this
    package makes the observations itself.
    """
    observables = super()._build_observables()
    for name in self._read_by_agent:
      reading = observable.Generic(self._ports[name].read)
      observables.add_observable(name, reading, enabled=True)
    return observables

  def iter_entities(
      self, exclude_self: bool = False
  ) -> Iterator[composer.Entity]:
    """Returns the mechanism and its parts that are in the world.

    The hooks for Composer come last, after those of the registers.
    """
    meters = [meter for _, meter, _ in self._phases.meters]
    hooks = [] if self._hooks is None else [self._hooks]
    registers = super().iter_entities(exclude_self)
    return itertools.chain(registers, meters, self._providers, hooks)

  def leave_phases(self, hooks: composer.Entity | None = None) -> None:
    """Leaves the phases of control steps to the caller, or to its hooks."""
    self._hooks = hooks
    self.observables.disable_all()

  @property
  def phases(self) -> phases.Phases:
    """Parts of a control step in which the mechanism acts."""
    return self._phases

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
        for _, meter, target in self._phases.meters
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
    return {
        name
        for provider in self._design.providers
        if provider.senses == providers.OWN
        for name in provider.sensed
    }

  @property
  def read_by_agent(self) -> list[str]:
    """Names of the ports that the agent reads."""
    return self._read_by_agent

  def _targets(self, names: Sequence[str]) -> list[_Target]:
    """Returns the writes that set the ports of these names, in their order."""
    targets: dict[str, _Target] = {}
    for name in names:
      register = self._design.register_of(name)
      if register not in targets:
        port_names = self._design.ports_by_register[register]
        targets[register] = _Target(
            self._registers[register],
            [self._ports[one] for one in port_names],
            port_names,
            [names.index(one) for one in port_names],
        )
    return [*targets.values()]

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
            ' the world; make a new task'
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
      ranges: Mapping[str, measurements.Range] | None = None,
  ) -> None:
    """Connects the meters to a world.

    Args:
      functions: Functions of the physics that meters can measure, by name.
      parts: Parts of the world that meters can measure, by name. `None` for
        those that its entities declare, and all bodies by their full MJCF
        identifiers, except the blocks of registers.
      privileged_senses: Functions of the physics that providers can sense, by
        name.
      ranges: Lowest and highest value of functions, by name; `None` if all are
        unknown.

    Raises:
      SpecError: If a meter of the design measures, or a register begins with,
        anything else, or values that its register cannot hold.
    """
    ranges = ranges or {}
    if parts is None:
      parts = assembly.parts_beside(self)
    self._instruments = {
        f'privileged/{name}'
        for name, function in (privileged_senses or {}).items()
        if isinstance(function, meters.Instrument)
    }
    for name, spec in self._design.registers.items():
      if isinstance(spec.initial, str):
        self._connect_initial(name, spec.initial, functions, ranges)
    pairs: dict[str, tuple[str, measurements.Measure]] = {}
    for i, meter_spec in enumerate(self._design.meters):
      location = messages.Location(
          f'design {self._design.name!r}', ('meters', i, 'measures')
      )
      asked = measurements.AskedRegisters(self._registers)
      self._asked.append(asked)
      world = measurements.World(location, functions, parts, asked, ranges)
      title, measure, range_ = measurements.connect(meter_spec.measures, world)
      asked.close()
      written = self._design.register_of(meter_spec.writes)
      self._check_range(written, f'meters.{i}', title, range_)
      pairs[meter_spec.writes] = f'meter:{title}', measure
    for target in self._targets([*pairs]):
      writers, measures = zip(*map(pairs.get, target.names), strict=True)
      meter = meters.Meter(_joint(measures), target.register, self._mjcf_root)
      self._phases.meters.append((writers, meter, target))
    self._is_connected = True

  def _connect_initial(
      self,
      name: str,
      initial: str,
      functions: Mapping[str, measurements.Measure],
      ranges: Mapping[str, measurements.Range],
  ) -> None:
    """Lets a register begin with `initial`, a name of a function.

    With ports, it may be what the names of their functions begin with.
    """
    register = self._registers[name]
    names = [f'{initial}_{port}' for port in register.PORTS]
    if not names or initial in functions:
      names = [initial]
    if any(name not in functions for name in names):
      raise errors.SpecError(
          f'design {self._design.name!r}: registers.{name}.initial: this'
          f' world does not offer {initial!r}'
          f'{messages.did_you_mean(initial, functions)}; must be'
          f' numbers or one of {sorted(functions)}'
      )
    for function in names:
      self._check_range(name, 'initial', function, ranges.get(function))
    values = [functions[name] for name in names]
    register.start_with(_stacked(values) if register.PORTS else values[0])

  def _check_range(
      self,
      register: str,
      source: str,
      title: str,
      needed: measurements.Range | None,
  ) -> None:
    """Checks that a register can hold what is measured for it.

    Otherwise clean feedback would hide what happens beyond its range.

    Args:
      register: Name of the register.
      source: What the values are for, as a key of the design.
      title: What is measured.
      needed: Lowest and highest value, or `None` if they are unknown.

    Raises:
      SpecError: If it cannot.
    """
    if needed is None:
      return
    spec = self._design.registers[register]
    low, high = spec.range
    if fitting.holds(spec.range, needed):
      return
    advice = (
        f'; give it a smaller registers.{register}.scale if it then lacks room'
        if spec.register_class.HAS_BLOCKS
        else ''
    )
    raise errors.SpecError(
        f'design {self._design.name!r}: registers.{register}.range:'
        f' [{low:g}, {high:g}]; must contain [{needed[0]:g}, {needed[1]:g}],'
        f' the range of {title!r} ({source}) in this world{advice}'
    )

  def step_count(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the number of completed control steps of the episode, `(...)`."""
    return self._counters.of(physics).step_count.copy()[()]

  def score(self, physics: protocols.Physics) -> np.ndarray:
    """Returns the true return up to the last control step, `(...)`.

    It is the measurement `score` of tasks without a score of their own.
    """
    return self._counters.of(physics).score.copy()[()]


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

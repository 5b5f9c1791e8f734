"""Specs of agent designs, and how to load them (paper, section 3.2)."""

from collections.abc import Mapping, Sequence
import functools
from typing import Annotated, Any, Literal, final
import warnings

import pydantic

from realab_suite import errors
from realab_suite.config import documents
from realab_suite.config import option_types
from realab_suite.config import validation
from realab_suite.entities import registers
from realab_suite.entities.registers import arguments
from realab_suite.entities.registers import ports
from realab_suite.feedback import consistency
from realab_suite.feedback import fitting
from realab_suite.feedback import measurements
from realab_suite.feedback import objectives
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import thresholds
from realab_suite.policies import action_sets

Name = arguments.Name
Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
# Larger numbers make the arithmetic of a step overflow.
Coordinate = Annotated[float, pydantic.Field(ge=-1e4, le=1e4)]
# Largest number of registers of a design. A hundred two-block registers load in
# a second and take 10 ms for a control step; both times are linear in the
# number. MuJoCo reserves 160 MB for their contacts, quadratic in the number.
MAX_REGISTERS = 100

READ_BY_AGENTS = consistency.READ_BY_AGENTS
WRITTEN_BY_PROVIDERS = consistency.WRITTEN_BY_PROVIDERS


@final
class PlaceSpec(validation.Spec):
  """A place for a register, given by coordinates.

  Attributes:
    position: `(x, y)`, or `(x, y, z)` for a register on a surface of the height
      z, in m.
    yaw: Angle of the register's axis to the x axis, in rad.
    spread: Half-widths of the region around `position` from which each episode
      draws the start position of the register, in m.
  """

  position: Annotated[
      tuple[Coordinate, ...],
      pydantic.Field(strict=False, min_length=2, max_length=3),
  ]
  yaw: Finite = 0.0
  spread: Annotated[
      tuple[
          Annotated[float, pydantic.Field(ge=0, le=100)],
          Annotated[float, pydantic.Field(ge=0, le=100)],
      ],
      pydantic.Field(strict=False),
  ] = (0.0, 0.0)

  @pydantic.field_validator('position')
  @classmethod
  def _above_the_floor(cls, value: tuple[float, ...]) -> tuple[float, ...]:
    if value[2:] < (0.0,) * len(value[2:]):
      raise ValueError('z must be at least 0, the height of the floor')
    return value


@final
class RegisterSpec(arguments.Arguments):
  """Spec of a register.

  A secure design overrides the channel. Without degrees of freedom, a
  register has those of the design.

  A range `{usual: [low, high]}` is not stated: it gives way to what a world
  declares, and with it a scale `{usual: scale}`; see `DesignSpec.fitted`.

  Attributes:
    kind: Name of a registered register kind.
    role: See `Arguments`.
    place: Name of a place of the world, or coordinates; `None` for a kind
      without blocks.
    ends_episode: Threshold of a `signal` register: the episode ends with the
      first control step after which the agent's reading crosses it. `None` if
      the register does not end episodes.
    options: Further keyword arguments of a user-defined register kind.
  """

  kind: Annotated[str, option_types.NameIn(register_kinds.REGISTER_KINDS)]
  role: arguments.Role
  place: (
      Annotated[
          Annotated[Name, pydantic.Tag('name')]
          | Annotated[PlaceSpec, pydantic.Tag('other')],
          arguments.TextOrOther,
      ]
      | None
  )
  ends_episode: thresholds.ThresholdSpec | None = None
  options: Annotated[
      dict[str, Any],
      option_types.OptionsOf(
          register_kinds.REGISTER_KINDS,
          'kind',
          method='_build',
          reserved=registers.Register._build,
      ),
  ] = pydantic.Field(default_factory=dict)

  @pydantic.model_validator(mode='wrap')
  @classmethod
  def _usual(cls, data: Any, handler: Any) -> 'RegisterSpec':
    """Accepts `{usual: ...}` for a range or a scale that is not stated."""
    data, is_open = fitting.read_open(data)
    made: RegisterSpec = handler(data)
    made.model_fields_set.difference_update(is_open)
    return made

  @pydantic.field_validator('place', mode='before')
  @classmethod
  def _coordinates(cls, place: Any) -> Any:
    """Accepts `[x, y]` and `[x, y, z]` for a place without yaw or spread."""
    if isinstance(place, list | tuple):
      return {'position': place}
    return place

  @pydantic.model_validator(mode='before')
  @classmethod
  def _without_place(cls, data: Any) -> Any:
    """Lets the place of a kind without blocks be left out."""
    kinds = register_kinds.REGISTER_KINDS
    if isinstance(data, Mapping) and 'place' not in data:
      kind = str(data.get('kind'))
      if kind in kinds and not kinds.get(kind).HAS_BLOCKS:
        return {**data, 'place': None}
    return data

  @pydantic.model_validator(mode='after')
  def _only_blocks_have_places(self) -> 'RegisterSpec':
    if (self.place is not None) != self.register_class.HAS_BLOCKS:
      raise ValueError(
          f'place: {self.kind} has no blocks; leave the place out'
          if self.place
          else f'place: must be a name or coordinates for kind {self.kind}'
      )
    return self

  @functools.cached_property
  def register_class(self) -> type[registers.Register]:
    """Class of the register when the spec was made; it may be replaced."""
    return register_kinds.REGISTER_KINDS.get(self.kind)

  @pydantic.model_validator(mode='after')
  def _find_class(self) -> 'RegisterSpec':
    _ = self.register_class
    return self

  @pydantic.model_validator(mode='after')
  def _ends_episodes(self) -> 'RegisterSpec':
    if self.ends_episode is None:
      return self
    if self.role != 'signal':
      raise ValueError(
          f"ends_episode: the role is {self.role!r}; must be 'signal'"
      )
    if len(set(map(self.ends_episode.is_crossed, self.range))) == 1:
      raise ValueError(
          f'ends_episode: all or no values in range {list(self.range)} are'
          f' {self.ends_episode.text}; it must divide the range'
      )
    return self


@final
class MeterSpec(validation.Spec):
  """Spec of a meter.

  Attributes:
    measures: Measurement, with its kind and options; or the name of a function
      that the task offers, or of a kind that needs no options.
    writes: Name of a register with role `meter`.
  """

  measures: Annotated[
      Name | measurements.Measurement,
      option_types.ModelIn(measurements.MEASUREMENTS, or_name=Name),
  ]
  writes: Name


@final
class ScheduleSpec(validation.Spec):
  """Schedule of meters and providers in a control step.

  Attributes:
    meter_substep: Number of substeps before the meters act.
    provider_substep: Number of substeps before the providers act.
  """

  meter_substep: Annotated[int, pydantic.Field(ge=0)]
  provider_substep: Annotated[int, pydantic.Field(ge=0)]

  @pydantic.model_validator(mode='after')
  def _in_order(self) -> 'ScheduleSpec':
    if self.meter_substep > self.provider_substep:
      raise ValueError(
          f'meter_substep {self.meter_substep} must not come after'
          f' provider_substep {self.provider_substep}'
      )
    return self

  def check(self, num_substeps: int) -> 'ScheduleSpec':
    """Returns the schedule after checking it against a control step.

    Args:
      num_substeps: Number of substeps of a control step.

    Raises:
      SpecError: If providers would act after the last substep.
    """
    if self.provider_substep >= num_substeps:
      raise errors.SpecError(
          f'schedule.provider_substep: {self.provider_substep} must be less'
          f' than the {num_substeps} substeps of a control step'
      )
    return self


@final
class ActionSetSpec(validation.Spec):
  """Reference to a set of discrete actions.

  The name alone refers to the newest version, which becomes part of the spec.

  Attributes:
    name: Name of the action set.
    version: Version of the action set.
  """

  name: Name
  version: int

  @pydantic.model_validator(mode='before')
  @classmethod
  def _find_newest(cls, data: Any) -> Any:
    if isinstance(data, str):
      return {'name': data, 'version': action_sets.newest(data).version}
    if not isinstance(data, Mapping | ActionSetSpec):
      raise ValueError('must be a name, or a mapping with name and version')
    return data

  @pydantic.model_validator(mode='after')
  def _known(self) -> 'ActionSetSpec':
    action_sets.get(self.name, self.version)
    return self


@final
class LearnerSpec(validation.Spec):
  """Spec of the learning algorithm of a design.

  Other fields than `kind` are options of the learner. A field that names a
  register must name one that agents may use. The field `objective` declares
  what the learner maximises, unless its kind does; see `objectives`.

  Attributes:
    kind: Name of the learner.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='allow', strict=True, populate_by_name=True
  )

  kind: Name


# Inside the class below, `providers` is the name of a field.
_Provider = providers.Provider
_AnyProvider = Annotated[_Provider, option_types.ModelIn(providers.PROVIDERS)]


@final
class DesignSpec(validation.Spec):
  """Spec of an agent design: a feedback function and a learner (section 3.2).

  Attributes:
    schema_version: Version of the file format; `schema` in a file.
    name: Name of the design.
    description: Description of the design, in a sentence.
    channel: Channel of the registers. `secure` overrides the channel of each
      register; `embedded` is the default of registers without a channel.
    dof: Degrees of freedom of the blocks of registers without a `dof`.
    registers: Registers, by name; at most `MAX_REGISTERS`.
    meters: Meters of the design.
    providers: Feedback providers, in the order in which they act.
    schedule: Schedule of meters and providers in a control step. `None` for
      meters after a third and providers after two thirds of the substeps,
      `cfmdp` for the literal order of the CFMDP: both before the first substep.
    action_set: Discrete actions of the agent; `None` for the continuous actions
      of the world.
    learner: Learning algorithm, or `None`.
  """

  schema_version: validation.Schema = pydantic.Field(alias='schema')
  name: Name
  description: str = ''
  channel: arguments.Channel = 'embedded'
  dof: arguments.Dof = 'free'
  registers: dict[Name, RegisterSpec] = pydantic.Field(default_factory=dict)
  meters: Annotated[tuple[MeterSpec, ...], pydantic.Field(strict=False)] = ()
  providers: Annotated[
      tuple[_AnyProvider, ...],
      pydantic.Field(strict=False),
  ] = ()
  schedule: ScheduleSpec | Literal['cfmdp'] | None = None
  action_set: ActionSetSpec | None = None
  learner: LearnerSpec | None = None

  @pydantic.model_validator(mode='after')
  def _consistent(self) -> 'DesignSpec':
    if len(self.registers) > MAX_REGISTERS:
      raise ValueError(
          f'registers: {len(self.registers)} are given; there must be at most'
          f' {MAX_REGISTERS}'
      )
    consistency.check(self)
    return self

  @functools.cached_property
  def ports(self) -> dict[str, RegisterSpec]:
    """Specs of the registers, by the names of their ports.

    A register that stores one number is its own port.
    """
    return {
        port: self.registers[name]
        for name, named in self.ports_by_register.items()
        for port in named
    }

  @functools.cached_property
  def ports_by_register(self) -> dict[str, list[str]]:
    """Names of the ports of each register, by its name."""
    return {
        name: ports.names(name, spec.register_class)
        for name, spec in self.registers.items()
    }

  def register_of(self, port: str) -> str:
    """Returns the name of the register that a port belongs to."""
    return next(
        name for name, named in self.ports_by_register.items() if port in named
    )

  def names(self, *roles: str) -> list[str]:
    """Returns the names of the ports of registers with one of the roles.

    Args:
      *roles: Roles of registers.

    Returns:
      Names in the order of `ports`.
    """
    return [n for n, spec in self.ports.items() if spec.role in roles]

  @property
  def objective(self) -> objectives.ObjectiveSpec | None:
    """What the learner maximises; `None` if it is not judged."""
    return self._objective[0]

  @property
  def why_not_judged(self) -> str:
    """Reason for a missing objective, or an empty string."""
    return self._objective[1]

  @functools.cached_property
  def _objective(self) -> tuple[objectives.ObjectiveSpec | None, str]:
    spec, reason = objectives.of_learner(self.learner)
    if spec and spec.kind == objectives.AGREEMENT and not self.action_set:
      return None, 'an agreement needs actions with indices: an action_set'
    return spec, reason

  def integer_queries(self) -> list[str]:
    """Returns the names of the query registers for indices of actions.

    Every provider that reads such a register uses the reading as an index.
    Query registers without readers may store any number.
    """
    return [
        name
        for name in self.names('query')
        if (readers := [p for p in self.providers if name in p.reads])
        and all(name in provider.action_queries for provider in readers)
    ]

  def in_world(self, solver: str | None) -> 'DesignSpec':
    """Returns the design with the solver of a world in place of `solver`.

    Args:
      solver: Name of the policy that solves the task; `None` if there is none.

    Raises:
      SpecError: If there is none, or if the solver does not fit the design.
    """
    where = f'design {self.name!r}'
    try:
      adapted = tuple(one.in_world(solver) for one in self.providers)
    except errors.SpecError as error:
      raise errors.SpecError(f'{where}: {error}') from error
    if adapted == self.providers:
      return self
    return validation.validate(
        DesignSpec, {**self.to_source(), 'providers': adapted}, where
    )

  def fitted(self, *worlds: Mapping[str, measurements.Range]) -> 'DesignSpec':
    """Returns the design with the ranges that it needs in worlds.

    Ranges that are stated stay, as do those that contain what the worlds
    declare; see `fitting`. The others stay open to further worlds.

    Args:
      *worlds: Ranges of what each world measures, by name.

    Raises:
      SpecError: If no range that the design may have is large enough.
    """
    changes = fitting.changes(self, worlds)
    if not changes:
      return self
    data = self.to_source()
    for name, (ends, scale) in changes.items():
      source = data['registers'][name]
      source['range'] = {fitting.USUAL: [*ends]}
      if 'scale' not in self.registers[name].model_fields_set:
        source['scale'] = {fitting.USUAL: scale}
    where = f'design {self.name!r}, with the ranges that this world needs'
    fitted = validation.validate(DesignSpec, data, where)
    for name, (_, scale) in changes.items():
      if scale < min(fitting.FINE, self.registers[name].scale):
        warnings.warn(
            f'{where}: registers.{name}.scale is {scale:g}, so a block that is'
            f' 1 mm off adds {1e-3 / scale:g}; state another range, or scale',
            stacklevel=2,
        )
    return fitted

  def to_source(self) -> dict[str, Any]:
    """Returns the design with what its registers do not state left open.

    They lack an `initial` that they do not state. A stated value may be kept by
    a register that no provider writes.
    """
    data = self.to_mapping()
    for name, spec in self.registers.items():
      source = data['registers'][name]
      if 'initial' not in spec.model_fields_set:
        del source['initial']
      for key in {'range', 'scale'} - spec.model_fields_set:
        source[key] = {fitting.USUAL: source[key]}
    return data

  def channel_of(self, name: str) -> arguments.Channel:
    """Returns the channel of a register.

    A secure design is the twin of another design, so its channel overrides the
    channel of each register.

    Args:
      name: Name of the register or of one of its ports.
    """
    if self.channel != 'embedded':
      return self.channel
    spec = self.registers.get(name) or self.ports[name]
    return spec.channel or 'embedded'

  def is_movable(self, name: str) -> bool:
    """Returns True if physics can change the content of a register.

    Args:
      name: Name of the register or of one of its ports.
    """
    spec = self.registers.get(name) or self.ports[name]
    has_blocks = spec.register_class.HAS_BLOCKS
    return has_blocks and self.channel_of(name) == 'embedded'

  def schedule_for(self, num_substeps: int) -> ScheduleSpec:
    """Returns the schedule of a control step.

    Args:
      num_substeps: Number of substeps of a control step.

    Raises:
      SpecError: If providers would act after the last substep.
    """
    if self.schedule is None:
      return ScheduleSpec(
          meter_substep=num_substeps // 3,
          provider_substep=2 * num_substeps // 3,
      )
    if self.schedule == 'cfmdp':
      return ScheduleSpec(meter_substep=0, provider_substep=0)
    return self.schedule.check(num_substeps)


Design = documents.Source | DesignSpec

_DOCUMENTS = documents.Documents('design', DesignSpec, 'designs')

DESIGNS = _DOCUMENTS.names
"""Names of the designs that are part of the package."""


def load(design: Design, overrides: Sequence[str] = ()) -> DesignSpec:
  """Loads and validates a design.

  Args:
    design: Name of a design of this package, path of a YAML file, mapping, or
      spec.
    overrides: Dotted overrides, such as `registers.reward.scale=0.2`. The
      override `channel=secure` makes the secure twin of a design.

  Raises:
    SpecError: If the design or an override is wrong; the message is one line
      with the file, the key path and the allowed values.
    UnknownNameError: If there is no design or file of this name.
  """
  return _DOCUMENTS.load(design, overrides)


def inputs_of(provider: providers.Provider, design: DesignSpec) -> list[str]:
  """Returns the names of the registers that a provider reads or sees.

  Args:
    provider: A provider of the design.
    design: The design.
  """
  return [*provider.reads, *design.names(*READ_BY_AGENTS)]

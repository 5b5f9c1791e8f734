"""Designs: what an agent designer decides, as data (paper, section 3.2)."""

from collections.abc import Mapping, Sequence
import functools
from importlib import resources
import operator
import os
from typing import Annotated, Any, Literal, final

import pydantic

from realab_suite import errors
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import option_types
from realab_suite.config import validation
from realab_suite.entities import block_kinds
from realab_suite.entities import registers
from realab_suite.feedback import consistency
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.policies import action_sets

_NAME = r'^[a-z][a-z0-9_]{0,63}$'
Name = Annotated[str, pydantic.StringConstraints(pattern=_NAME)]
Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
# Larger ones make the arithmetic of a step overflow.
Coordinate = Annotated[float, pydantic.Field(ge=-1e4, le=1e4)]
Value = Annotated[float, pydantic.Field(ge=-1e9, le=1e9)]
Size = Annotated[float, pydantic.Field(ge=block_kinds.LEAST_SIZE, le=1.0)]
Channel = Literal['embedded', 'welded', 'secure']
Dof = Literal['free', 'planar']
Role = Literal['feedback', 'meter', 'query', 'signal']

# Number of registers that a design may have. A hundred two-block registers load
# in a second and take 10 ms for a control step, and both grow with the number.
# The memory that MuJoCo reserves for contacts, 160 MB, grows with its square.
MAX_REGISTERS = 100

# Roles whose registers the agent reads, and those that it never does.
READ_BY_AGENTS = ('feedback', 'signal')


@final
class PlaceSpec(validation.Spec):
  """Coordinates, or a region around them.

  Attributes:
    position: `(x, y)`, metres.
    yaw: The angle of the register's axis to the x axis, radians.
    spread: Half-widths of the region, metres, in which the register stands at
      random in each episode.
  """

  position: Annotated[
      tuple[Coordinate, Coordinate], pydantic.Field(strict=False)
  ]
  yaw: Finite = 0.0
  spread: Annotated[
      tuple[
          Annotated[float, pydantic.Field(ge=0, le=100)],
          Annotated[float, pydantic.Field(ge=0, le=100)],
      ],
      pydantic.Field(strict=False),
  ] = (0.0, 0.0)


@final
class RegisterSpec(validation.Spec):
  """A register: what it is, what it is for, and where it stands.

  Attributes:
    kind: A registered kind of register.
    role: `feedback` and `signal` registers are read by the agent, `meter`
      registers by providers only, `query` registers are written by the agent.
    place: The name of a place that the world offers, or coordinates.
    range: The lowest and the highest value.
    scale: Metres (radians for an orientation) per unit.
    initial: The value at the start of an episode.
    on_overflow: What happens to a value out of range.
    channel: What can influence the value, unless the design as a whole is
      welded or secure; `None` for embedded.
    dof: How a block can move; `None` takes the design's.
    block_size: The length of an edge of a block, metres.
    mass: Of a block, kilograms.
    options: Further keyword arguments of a register kind of your own.
  """

  kind: Annotated[str, option_types.NameIn(register_kinds.REGISTER_KINDS)]
  role: Role
  place: Name | PlaceSpec
  range: Annotated[tuple[Value, Value], pydantic.Field(strict=False)]
  # Below it, what is left of a reading is the noise of positions.
  scale: Annotated[float, pydantic.Field(ge=1e-6, le=10)] = 0.1
  initial: Value = 0.0
  on_overflow: Literal['saturate', 'error'] = 'saturate'
  channel: Channel | None = None
  dof: Dof | None = None
  block_size: Size = 0.2
  mass: Annotated[float, pydantic.Field(ge=0.01, le=100)] = 1.0
  options: Annotated[
      dict[str, Any],
      option_types.OptionsOf(
          register_kinds.REGISTER_KINDS,
          'kind',
          method='_build',
          reserved=registers.Register._build,
      ),
  ] = pydantic.Field(default_factory=dict)

  @pydantic.field_validator('place', mode='before')
  @classmethod
  def _coordinates(cls, place: Any) -> Any:
    """Lets `[x, y]` stand for a place without yaw or spread."""
    if isinstance(place, list | tuple):
      return {'position': place}
    return place

  @pydantic.model_validator(mode='after')
  def _in_order(self) -> 'RegisterSpec':
    low, high = self.range
    if not low < high:
      raise ValueError(f'range {list(self.range)} must have low < high')
    if not low <= self.initial <= high:
      raise ValueError(
          f'initial {self.initial} must be in range {list(self.range)}'
      )
    return self


@final
class MeterSpec(validation.Spec):
  """A meter.

  Attributes:
    measures: The name of a measurement that the world offers.
    writes: A register whose role is `meter`.
  """

  measures: Name
  writes: Name


@final
class ScheduleSpec(validation.Spec):
  """After which substeps of a control step meters and providers act.

  Attributes:
    meter_substep: How many substeps come before the meters.
    provider_substep: How many come before the providers.
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
    """Returns the schedule if it fits a control step.

    Raises:
      SpecError: If a provider would act when the step is over.
    """
    if self.provider_substep >= num_substeps:
      raise errors.SpecError(
          f'schedule.provider_substep: {self.provider_substep} must be less'
          f' than the {num_substeps} substeps of a control step'
      )
    return self


@final
class ActionSetSpec(validation.Spec):
  """Which discrete action set the agent acts by.

  Attributes:
    name: The name of the set.
    version: Which list of that name.
  """

  name: Name
  version: int

  @pydantic.model_validator(mode='after')
  def _known(self) -> 'ActionSetSpec':
    try:
      action_sets.get(self.name, self.version)
    except errors.UnknownNameError as error:
      raise ValueError(str(error)) from error
    return self


@final
class LearnerSpec(validation.Spec):
  """The learning algorithm, for whoever trains an agent of this design.

  Fields besides `kind` are the learner's own. Where one names a register, it
  has to be a register that an agent may use.

  Attributes:
    kind: The name of the learner.
  """

  model_config = pydantic.ConfigDict(
      frozen=True, extra='allow', strict=True, populate_by_name=True
  )

  kind: Name


@final
class _AnyProvider:
  """Validates a provider by the class that its `kind` is registered as."""

  @classmethod
  def members(
      cls, siblings: Mapping[str, Any] | None = None
  ) -> list[type[providers.Provider]]:
    """The classes that are registered now."""
    del siblings
    return [providers.PROVIDERS.get(kind) for kind in providers.PROVIDERS]

  @classmethod
  def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
    del source
    union = functools.reduce(operator.or_, cls.members())
    return handler.generate_schema(
        Annotated[union, pydantic.Field(discriminator='kind')]
    )


# Inside the class below, `providers` is the name of a field.
_Provider = providers.Provider


@final
class DesignSpec(validation.Spec):
  """An agent design: a feedback function and a learner (section 3.2).

  Attributes:
    schema_version: The version of this format; `schema` in a file.
    name: The name of the design.
    description: What it is, in a sentence.
    channel: `welded` and `secure` go for every register; `embedded` for those
      that do not say otherwise.
    dof: Of every register that does not say otherwise.
    registers: The registers, by name; at most `MAX_REGISTERS`.
    meters: What is measured into which meter register.
    providers: The feedback providers, in the order in which they act.
    schedule: When they act; `None` for a third and two thirds of the control
      step, `cfmdp` for the literal order of the CFMDP: both before the world
      ticks.
    action_set: The discrete actions of the agent, or `None` for the world's
      continuous ones.
    learner: The learning algorithm, or `None`.
  """

  schema_version: Literal[1] = pydantic.Field(alias='schema')
  name: Name
  description: str = ''
  channel: Channel = 'embedded'
  dof: Dof = 'free'
  registers: dict[Name, RegisterSpec] = pydantic.Field(
      default_factory=dict, json_schema_extra={'maxProperties': MAX_REGISTERS}
  )
  meters: Annotated[tuple[MeterSpec, ...], pydantic.Field(strict=False)] = ()
  providers: Annotated[
      tuple[Annotated[_Provider, _AnyProvider], ...],
      pydantic.Field(strict=False),
  ] = ()
  schedule: ScheduleSpec | Literal['cfmdp'] | None = None
  action_set: ActionSetSpec | None = None
  learner: LearnerSpec | None = None

  @pydantic.field_validator('schema_version', mode='before')
  @classmethod
  def _whole(cls, value: Any) -> Any:
    """Keeps `true` and `1.0`, which Python takes for 1, from being versions."""
    if type(value) is not int:
      raise ValueError('must be 1')
    return value

  @pydantic.field_serializer('providers')
  def _dump_providers(
      self, value: tuple[_Provider, ...]
  ) -> list[dict[str, Any]]:
    return [provider.model_dump(mode='json') for provider in value]

  @pydantic.model_validator(mode='after')
  def _consistent(self) -> 'DesignSpec':
    if len(self.registers) > MAX_REGISTERS:
      raise ValueError(
          f'registers: {len(self.registers)} are given; allowed are at most'
          f' {MAX_REGISTERS}'
      )
    consistency.check(self, READ_BY_AGENTS)
    return self

  def names(self, *roles: str) -> list[str]:
    """Returns the names of the registers with one of these roles, in order."""
    return [n for n, spec in self.registers.items() if spec.role in roles]

  def integer_queries(self) -> list[str]:
    """Returns the names of the query registers that hold an action's index.

    These are the ones whose every reader takes the reading for an index. A
    query register without readers may hold any number.
    """
    return [
        name
        for name in self.names('query')
        if (readers := [p for p in self.providers if name in p.reads])
        and all(name in provider.action_queries for provider in readers)
    ]

  def channel_of(self, name: str) -> Channel:
    """Returns the channel of a register.

    A design that is welded or secure is so as a whole, whatever its registers
    say: it is the twin of another one.
    """
    if self.channel != 'embedded':
      return self.channel
    return self.registers[name].channel or 'embedded'

  def schedule_for(self, num_substeps: int) -> ScheduleSpec:
    """Returns the schedule for control steps of `num_substeps` substeps.

    Raises:
      SpecError: If the schedule does not fit.
    """
    if self.schedule is None:
      return ScheduleSpec(
          meter_substep=num_substeps // 3,
          provider_substep=2 * num_substeps // 3,
      )
    if self.schedule == 'cfmdp':
      return ScheduleSpec(meter_substep=0, provider_substep=0)
    return self.schedule.check(num_substeps)


Design = str | os.PathLike[str] | Mapping[str, Any] | DesignSpec

_validated_kinds: list[type[_Provider]] = []


def load(
    design: Design,
    overrides: Sequence[str] = (),
    *,
    is_confined: bool = False,
) -> DesignSpec:
  """Loads and validates a design.

  Files that the file of a design names have to be within the working directory.

  Args:
    design: The name of a design that ships with the package, a path to a YAML
      file, a mapping, or a spec.
    overrides: Dotted overrides, as in `registers.reward.scale=0.2`; the secure
      twin of a design is `channel=secure`.
    is_confined: Whether that goes for files that `overrides` name, too, and for
      the design itself.

  Raises:
    SpecError: Where the file, key path or override is wrong, in one line.
  """
  if isinstance(overrides, str) or not isinstance(overrides, Sequence):
    raise errors.SpecError(
        f'overrides: {messages.quote(overrides)}; allowed is a list of texts,'
        " as in ['channel=secure']"
    )
  is_file = False
  if isinstance(design, DesignSpec):
    where, data = f'design {design.name!r}', design.to_mapping()
  elif isinstance(design, str) and design in DESIGNS:
    where = f'{design}.yaml'
    data = loading.parse_yaml(_shipped(design).read_bytes(), where)
  elif not isinstance(design, str | os.PathLike | Mapping):
    raise errors.SpecError(
        f'design: {messages.quote(design)}; allowed are a name, a path, a'
        ' mapping and a DesignSpec'
    )
  elif isinstance(design, str) and not os.path.exists(design):
    raise errors.UnknownNameError(
        f'design {messages.quote(design)} is neither a file nor one of'
        f' {list(DESIGNS)}'
    )
  elif isinstance(design, Mapping):
    where, data = 'design', loading.read_mapping(design)
  else:
    where = os.fspath(design)
    if is_confined and not loading.is_inside(where):
      raise errors.SpecError(
          f'design {messages.quote(where)} is outside the working directory;'
          f' allowed in a file are paths within it and {list(DESIGNS)}'
      )
    data, is_file = loading.read_mapping(design), True
  _learn_new_kinds()
  return validation.validate(
      DesignSpec,
      data,
      where,
      overrides,
      is_confined=is_file or is_confined,
      are_overrides_free=not is_confined,
  )


def json_schema() -> dict[str, Any]:
  """Returns the JSON Schema of a design file, for editors."""
  _learn_new_kinds()
  return DesignSpec.model_json_schema(by_alias=True)


def _learn_new_kinds() -> None:
  """Rebuilds the validator if other providers are registered than before."""
  kinds = _AnyProvider.members()
  if _validated_kinds != kinds:
    DesignSpec.model_rebuild(force=True)
    _validated_kinds[:] = kinds


def _shipped(name: str) -> Any:
  return _FOLDER / f'{name}.yaml'


_FOLDER = resources.files('realab_suite.configs') / 'designs'
DESIGNS: tuple[str, ...] = tuple(
    sorted(
        path.name.removesuffix('.yaml')
        for path in _FOLDER.iterdir()
        if path.name.endswith('.yaml')
    )
)

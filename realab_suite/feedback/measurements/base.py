"""Base class for measurements, their registry, and the world they refer to."""

import abc
from collections.abc import Callable, Iterator, Mapping, Sequence
import dataclasses
import json
import re
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.entities import measurables
from realab_suite.entities import registers

Measure = Callable[[Any], np.ndarray]
"""Function of the physics that returns the measured values, `(...)`."""

Range = tuple[float, float]
"""Lowest and highest value that a measurement can have."""

PartName = Annotated[str, pydantic.Field(min_length=1, max_length=200)]
"""Name of a register of the design, or of a part of the world."""

# `registers` is also the name of a field.
_Register = registers.Register

# Largest number of names in an error message.
_MAX_NAMES = 30


@final
class AskedRegisters(Mapping[str, _Register]):
  """Registers of a design, and which of them a measurement has asked for.

  A measurement asks while it is connected. Later, it is too late to say what it
  measures.

  Attributes:
    asked: Names of those whose blocks it may measure.
  """

  def __init__(self, registers_by_name: Mapping[str, _Register]) -> None:
    self._registers = registers_by_name
    self.asked: set[str] = set()
    self._is_closed = False

  def close(self) -> None:
    """Refuses to return registers from now on."""
    self._is_closed = True

  def ask_for_blocks(self, bodies: Sequence[Any]) -> None:
    """Asks for the registers that have blocks among bodies of the world."""
    for name, register in self._registers.items():
      blocks = [block.body for block in register.blocks]
      if any(body is block for body in bodies for block in blocks):
        self.asked.add(name)

  def __getitem__(self, name: str) -> _Register:
    if self._is_closed:
      raise errors.SpecError(
          f'a measurement asks for register {messages.quote(name)} while it'
          ' measures; ask for it in `connect`'
      )
    register = self._registers[name]
    self.asked.add(name)
    return register

  def __contains__(self, name: object) -> bool:
    return name in self._registers

  def __iter__(self) -> Iterator[str]:
    return iter(self._registers)

  def __len__(self) -> int:
    return len(self._registers)


@final
@dataclasses.dataclass(frozen=True)
class World:
  """The parts of a world that a measurement can refer to.

  Attributes:
    location: Location of the measurement in the design, for messages.
    functions: Functions of the physics that the task offers, by name.
    parts: Parts that the task and its entities declare, by name. In a foreign
      task, also all bodies, by their full MJCF identifiers.
    registers: Registers of the design, by name.
    ranges: Ranges of functions, by name; others are unknown.
  """

  location: messages.Location
  functions: Mapping[str, Measure]
  parts: Mapping[str, measurables.Measurable]
  registers: AskedRegisters
  ranges: Mapping[str, Range] = dataclasses.field(default_factory=dict)

  def part(self, field: str, name: str) -> measurables.Measurable:
    """Returns a part of the world; the blocks of a register are a group.

    A register whose blocks it contains is recorded as measured.

    Args:
      field: Key of the option that contains the name, for messages.
      name: Name of a register or of a part.

    Raises:
      SpecError: If the world has no such part, or a register has its name.
    """
    if name in self.registers:
      if name in self.parts:
        raise self.error(
            field,
            f'{name!r} is a register and a part of this world, and'
            ' must mean one of them: rename the register',
        )
      blocks = self.registers[name].blocks
      return measurables.Measurable(tuple(b.body for b in blocks))
    if name in self.parts:
      part = self.parts[name]
      self.registers.ask_for_blocks(part.bodies)
      return part
    raise self.unknown(field, name, [*self.registers, *self.parts])

  def body(self, field: str, name: str) -> measurables.Measurable:
    """Returns a part with one body; the first block of a register.

    Args:
      field: Key of the option that contains the name, for messages.
      name: Name of a register or of a part.

    Raises:
      SpecError: If there is no such part, or if it has several bodies.
    """
    part = self.part(field, name)
    if name in self.registers:
      return measurables.Measurable(part.bodies[:1])
    if len(part.bodies) > 1:
      single = [n for n, p in self.parts.items() if len(p.bodies) == 1]
      raise self.error(
          field,
          f'{name!r} has {len(part.bodies)} bodies; must be a part with one:'
          f' {_listed([*self.registers, *single])}',
      )
    return part

  def register(self, field: str, name: str) -> _Register:
    """Returns a register of the design.

    Args:
      field: Key of the option that contains the name, for messages.
      name: Name of the register.

    Raises:
      SpecError: If the design has no such register.
    """
    if name not in self.registers:
      raise self.unknown(field, name, self.registers)
    return self.registers[name]

  def unknown(self, field: str, name: str, known: Any) -> errors.SpecError:
    """Returns the error for a name that is not one of the known names."""
    return self.error(
        field,
        f'{messages.quote(name)} cannot be measured in this world'
        f'{messages.did_you_mean(name, known)}; must be one of'
        f' {_listed(known)}',
    )

  def error(self, field: str, problem: str) -> errors.SpecError:
    """Returns an error about an option of the measurement.

    Args:
      field: Key of the option.
      problem: The given value, and the allowed values.
    """
    return self.location.child(field).error(problem)


class Measurement(validation.Model):
  """Base class for measurements: functions of the true state of a world.

  Fields of a subclass are its options in a design, as for providers. `connect`
  runs once, when the design is connected to a task, and returns the function
  that the meter then calls in every control step.

  Attributes:
    kind: Name under which the class is registered.
  """

  model_config = pydantic.ConfigDict(allow_inf_nan=False)

  kind: str

  @abc.abstractmethod
  def connect(self, world: World) -> Measure:
    """Returns the function of the physics to measure with.

    The function gets one world or a batch and returns finite values, `(...)`.
    It reads trailing axes (`x[..., 0]`), changes nothing and keeps no state.

    Args:
      world: The parts of the world, by name.

    Raises:
      SpecError: If the world lacks a part; the methods of `world` raise it.
    """

  def range_in(self, world: World) -> Range | None:
    """Returns the range of what is measured, or `None` if it is unknown.

    Args:
      world: The parts of the world, by name.
    """
    del world
    return None

  @property
  def title(self) -> str:
    """Name of a meter in records: kind and options that are not defaults.

    For instance `distance(from=avatar, to=pad)`. Measurements with different
    options have different titles.
    """
    options = self.model_dump(mode='json', by_alias=True, exclude_defaults=True)
    options.pop('kind', None)
    listed = ', '.join(f'{k}={_text(v)}' for k, v in options.items())
    return f'{self.kind}({listed})' if listed else self.kind


_MODULES = {
    'events': ('score', 'collected', 'time'),
    'motion': ('distance', 'position', 'contacts'),
    'tampering': ('detector',),
}
MEASUREMENTS: registry.Registry[type[Measurement]] = registry.Registry(
    'measurement kind',
    {
        kind: f'realab_suite.feedback.measurements.{module}'
        for module, kinds in _MODULES.items()
        for kind in kinds
    },
)


def connect(
    measures: str | Measurement, world: World
) -> tuple[str, Measure, Range | None]:
  """Returns the title of a measurement, its function, and its range if known.

  Args:
    measures: A measurement; or the name of a function of the task, or of a
      kind that needs no options.
    world: The parts of the world, by name.

  Raises:
    SpecError: If this world does not offer the measurement.
  """
  if isinstance(measures, str):
    if measures in world.functions:
      return measures, world.functions[measures], world.ranges.get(measures)
    measures = _without_options(measures, world)
  try:
    measure = measures.connect(world)
    return measures.title, measure, measures.range_in(world)
  except errors.RealabError:
    raise
  except Exception as error:  # Measurements may raise any class.
    raise world.location.error(messages.exception(error)) from error


def _without_options(name: str, world: World) -> Measurement:
  """Returns the measurement of a kind without options.

  Raises:
    SpecError: If there is no such kind, or if it needs options.
  """
  kinds = sorted(MEASUREMENTS)
  if name not in MEASUREMENTS:
    raise world.location.error(
        f'{messages.quote(name)} cannot be measured in this world'
        f'{messages.did_you_mean(name, world.functions)}; must be'
        f' {_listed(world.functions)}, or a mapping with a kind of {kinds}'
    )
  try:
    return MEASUREMENTS.get(name)(kind=name)
  except pydantic.ValidationError as error:
    needed = [str(e['loc'][0]) for e in error.errors() if e['loc']]
    raise world.location.error(
        f'{name!r} needs the options {needed}; must be a mapping with'
        f" 'kind: {name}' and these options"
    ) from error


def _listed(names: Any) -> str:
  """Returns names as a list for messages; only the first of very many."""
  ordered = sorted(names)
  if len(ordered) <= _MAX_NAMES:
    return str(ordered)
  return f'{ordered[:_MAX_NAMES]} and {len(ordered) - _MAX_NAMES} more'


def _text(value: Any) -> str:
  """Returns an option as text, quoted if it has unusual characters."""
  if isinstance(value, str) and re.fullmatch(r'[\w./-]+', value):
    return value
  return json.dumps(value, sort_keys=True)

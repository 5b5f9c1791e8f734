"""Base class for feedback providers, and their registry."""

import abc
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.entities import axes
from realab_suite.policies import base as policies

Observation = Mapping[str, np.ndarray]
Readings = Mapping[str, np.ndarray]
# A value to write, or a value and a mask.
Writes = Mapping[str, np.ndarray | tuple[np.ndarray, np.ndarray]]
Range = tuple[float, float]
# Files contain lists, but strict validation accepts only tuples.
Names = Annotated[tuple[str, ...], pydantic.Field(strict=False)]
OneName = Annotated[
    tuple[str, ...], pydantic.Field(strict=False, min_length=1, max_length=1)
]
OF_AGENT: Final = 'agent'
OWN: Final = 'own'

_Self = TypeVar('_Self', bound='Provider')


class Provider(validation.Model):
  """Base class for feedback providers: pure functions from readings to writes.

  Fields of a subclass are its options, methods are its behaviour. A provider
  has the same interface as an agent: it maps observations to actions, and its
  actions are writes to registers (paper, section 3.1). It gets neither the
  physics nor the true reward. Because it is pure, one provider serves a whole
  batch: the leading axis of every array is the axis of worlds.

  By default, it senses what the agent senses, as in the paper. A supervisor who
  sees more has senses of its own, which agents never get.

  Attributes:
    kind: Name under which the class is registered.
    reads: Names of the registers whose readings the provider gets.
    writes: Names of the registers that the provider may write.
    every: The provider acts in steps 1, 1 + every, 1 + 2 every ... of an
      episode. In the other steps it is not called, and writes nothing.
    senses: `agent` if the agent must have the senses that the provider reads;
      `own` if they are computed for the provider, whatever the agent has.
  """

  kind: str
  reads: Names = ()
  writes: Names
  # Steps are compared as 64-bit integers.
  every: Annotated[int, pydantic.Field(ge=1, le=10**9)] = 1
  # The digests of designs from before there was a choice stay the same.
  senses: Literal['agent', 'own'] = pydantic.Field(
      OF_AGENT, exclude_if=lambda senses: senses == OF_AGENT
  )

  @pydantic.model_validator(mode='after')
  def _has_its_registers(self: _Self) -> _Self:
    """Refuses too few registers for what a class declares about itself."""
    try:
      _ = (*self.action_queries, *self.action_writes, self.is_repeatable)
      _ = self.sensed
    except LookupError as error:
      if not isinstance(error, errors.RealabError):  # Others explain more.
        raise ValueError(self.why_it_failed(error)) from error
    return self

  def why_it_failed(self, error: Exception) -> str:
    """Returns an error of a method, and the registers where it may lack one.

    Args:
      error: The error.
    """
    text = messages.exception(error)
    if isinstance(error, LookupError) or 'to unpack' in text:
      text += (
          f'; it got the registers reads: {[*self.reads]}, writes:'
          f' {[*self.writes]}; must be all that {self.kind!r} uses'
      )
    return text

  @property
  def action_queries(self) -> tuple[str, ...]:
    """Names in `reads` whose readings are rounded to the index of an action.

    Override this in a subclass that reads an index from a query register.
    """
    return ()

  @property
  def action_writes(self) -> tuple[str, ...]:
    """Names in `writes` to which the index of an action is written.

    Override this in a subclass that writes an index.
    """
    return ()

  def acts_in(self, step: Any) -> axes.Mask:
    """Returns the worlds in which the provider acts; `None` for all worlds.

    Args:
      step: Control step of each world, `(...)` int, from 1.
    """
    if self.every == 1:
      return None
    return axes.both((step - 1) % self.every == 0, None)

  @property
  def required_senses(self) -> tuple[str, ...]:
    """Names of the senses that the provider reads.

    The agent must have them, unless `senses` is `own`. Override this in a
    subclass that reads senses.
    """
    return ()

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    """Names of functions of the task that the provider reads as well.

    They are keys of `Task.privileged_senses`, and in observations
    `privileged/<name>`. Only a provider with `senses: own` gets them.
    """
    return ()

  @property
  def sensed(self) -> tuple[str, ...]:
    """Names of all senses that the provider reads, as `privileged/<name>`."""
    privileged = (f'privileged/{name}' for name in self.privileged_senses)
    return (*self.required_senses, *privileged)

  def in_world(self: _Self, solver: str | None) -> _Self:
    """Returns the provider with the solver of a world in place of `solver`.

    Args:
      solver: Name of the policy that solves the task; `None` if there is none.

    Raises:
      SpecError: If the provider needs a solver, and there is none.
    """
    data = self.model_dump()
    fields = _with_solver(data, solver)
    if fields == data:
      return self
    if solver is None:
      raise errors.SpecError(
          f'{self.kind} names {policies.SOLVER!r}, but this world has none;'
          ' name other policies'
      )
    return type(self).model_validate(fields)

  @property
  def is_repeatable(self) -> bool:
    """False if `step` cannot be called twice, because a person answers it.

    What such a provider writes counts as the clean content of its registers.
    """
    return True

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the state before the first step.

    In a batch, the state consists of arrays with a leading axis of worlds, in
    any nesting of tuples, lists and dicts.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for a batch.
    """
    del batch_shape
    return ()

  def write_ranges(self, ranges: Mapping[str, Range]) -> Mapping[str, Range]:
    """Returns the ranges of what the provider writes, by name, where known.

    Override this in a subclass whose writes are in the units of its reads.

    Args:
      ranges: Lowest and highest value of each register, by name.
    """
    del ranges
    return {}

  @abc.abstractmethod
  def step(
      self,
      observation: Observation,
      readings: Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[Writes, Any]:
    """Computes the feedback of one control step.

    Args:
      observation: Observation that the agent's action responds to, with keys
        `senses/<name>` of the required senses and `registers/<name>`.
      readings: Reading of each register in `reads`, by name, `(...)`.
      episode_start: True for each world in the first step of an episode,
        `(...)` bool. Worlds of a batch start their episodes at different times.
      key: Random key of each world, `(..., 2)` uint64; see `random_keys`.
      state: State that `initial_state` or the previous `step` returned.

    Returns:
      Value to write to each register, by name, `(...)`, in the register's
      units, and the next state. A register in `writes` that is left out keeps
      its value. A tuple `(value, mask)` writes only where the mask, `(...)`
      bool, is True.
    """

  def check(self, design: Any) -> None:
    """Checks that the provider fits a design.

    Args:
      design: The `specs.DesignSpec` that contains the provider.

    Raises:
      ValueError: If the provider does not fit the design.
    """


_KINDS = (
    'appraisal',
    'comparison',
    'constant',
    'demonstration',
    'difference',
    'growth',
    'inspection',
    'paired_advice',
    'relay',
    'value_advice',
)
PROVIDERS: registry.Registry[type[Provider]] = registry.Registry(
    'provider kind',
    {kind: f'realab_suite.feedback.providers.{kind}' for kind in _KINDS},
)


def _with_solver(part: Any, solver: str | None) -> Any:
  """Returns fields of a provider, at any depth, with the name of a solver."""
  if not isinstance(part, Mapping):
    return part
  fields = {key: _with_solver(value, solver) for key, value in part.items()}
  if fields.get('policy') == policies.SOLVER:
    fields['policy'] = solver
  if fields.get('value_function') == policies.SOLVER_APPROVAL:
    fields['options'] = {'policy': solver, **(fields.get('options') or {})}
  return fields

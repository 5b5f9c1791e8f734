"""Demonstrations and advice where actions are vectors (paper, section 3.4).

There is one register for each element of the action.
`feedback/continuous_designs.py` makes such designs.
"""

import functools
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback.providers import base

_Names = Annotated[tuple[str, ...], pydantic.Field(strict=False, min_length=1)]


class _Controlled(base.Provider):
  """Base class for providers that run a controller.

  Attributes:
    controller: Name of a registered controller.
    options: Keyword arguments of the controller.
  """

  controller: Annotated[str, option_types.NameIn(policies.CONTROLLERS)]
  options: Annotated[
      dict[str, Any], option_types.OptionsOf(policies.CONTROLLERS, 'controller')
  ] = pydantic.Field(default_factory=dict)

  @functools.cached_property
  def demonstrator(self) -> policies.Controller:
    """Controller that computes the actions."""
    return policies.make_controller(self.controller, **self.options)

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self.demonstrator.required_senses

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return self.demonstrator.initial_state(batch_shape)

  def _refuse_other_number(self, field: str, names: tuple[str, ...]) -> None:
    """Refuses another number of registers than of elements."""
    number = self.demonstrator.num_elements
    if len(names) != number:
      raise ValueError(
          f'{field}: {len(names)} registers; allowed are {number}, one for each'
          f' element of the actions of {self.controller!r}'
      )


@base.PROVIDERS.add('continuous_demonstration')
@final
class ContinuousDemonstration(_Controlled):
  """Provider that writes the action of a controller, an element per register.

  `writes` names the registers in the order of the elements of the action.
  Elements out of the range of their register are saturated.
  """

  kind: Literal['continuous_demonstration'] = 'continuous_demonstration'
  writes: _Names

  def check(self, design: Any) -> None:
    del design
    self._refuse_other_number('writes', self.writes)

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    del readings
    action, state = self.demonstrator.step(
        observation, episode_start, key, state
    )
    return {name: action[..., i] for i, name in enumerate(self.writes)}, state


@base.PROVIDERS.add('continuous_advice')
@final
class ContinuousAdvice(_Controlled):
  """Provider that writes the value of the action that query registers hold.

  The value is 1 for the action of a controller. It falls with the distance
  from that action, and is -1 at `farthest`. `reads` names the query registers
  in the order of the elements. Their blocks are read, so a query can be
  corrupted.

  Attributes:
    farthest: Distance of a query from the controller's action at which the
      value is -1, in units of the action.
  """

  kind: Literal['continuous_advice'] = 'continuous_advice'
  reads: _Names
  writes: base.OneName
  farthest: Annotated[float, pydantic.Field(gt=0, le=1e9)] = 2.0

  def check(self, design: Any) -> None:
    self._refuse_other_number('reads', self.reads)
    for name in self.reads:
      if design.registers[name].role != 'query':
        raise ValueError(
            f'continuous_advice reads the query from {name!r}, whose role is'
            f' {design.registers[name].role!r}; allowed is query'
        )

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    action, state = self.demonstrator.step(
        observation, episode_start, key, state
    )
    query = np.stack([readings[name] for name in self.reads], axis=-1)
    distance = np.sqrt(((query - action) ** 2).sum(axis=-1))
    return {self.writes[0]: 1.0 - 2.0 * distance / self.farthest}, state

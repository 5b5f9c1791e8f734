"""Controllers: policies whose actions are vectors, for tasks without an index.

A controller is a pure function with an explicit state, as a `Policy` is. It
demonstrates or judges the control elements of any task.
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import registry
from realab_suite.policies import base

_Number = Annotated[float, pydantic.Field(allow_inf_nan=False)]


class Controller(abc.ABC):
  """Function from observations to actions, which are vectors."""

  @property
  @abc.abstractmethod
  def num_elements(self) -> int:
    """Number of elements of an action."""

  @property
  def required_senses(self) -> tuple[str, ...]:
    """Names of the senses that the controller reads from observations."""
    return ()

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the state before the first step; see `Policy`."""
    del batch_shape
    return ()

  @abc.abstractmethod
  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    """Returns the action, `(..., elements)`, and the next state.

    Arguments are those of `Policy.step`.
    """


CONTROLLERS: registry.Registry[Callable[..., Controller]] = registry.Registry(
    'controller'
)


def make_controller(name: str, /, **options: Any) -> Controller:
  """Makes the controller registered as `name`; raises like `make`."""
  return base.make_registered(CONTROLLERS, 'controller', name, options)


@CONTROLLERS.add('linear')
@final
class Linear(Controller):
  """Controller whose action is a linear function of senses."""

  def __init__(
      self,
      gains: Mapping[str, Sequence[Sequence[_Number]]],
      offset: Sequence[_Number] | None = None,
  ) -> None:
    """Makes the controller.

    Args:
      gains: Matrix for each sense, by name, `(elements, size of the sense)`.
      offset: Action if all senses are 0, `(elements,)`; `None` for 0.

    Raises:
      SpecError: If the matrices have different numbers of rows.
    """
    self._gains = {}
    rows = set() if offset is None else {len(offset)}
    for name, gain in gains.items():
      if not gain or len({len(row) for row in gain}) != 1:
        raise errors.SpecError(
            f'gains.{name}: {gain}; allowed is a matrix with a row for each'
            ' element of the action'
        )
      self._gains[name] = np.array(gain, float)
      rows.add(len(gain))
    if len(rows) != 1:
      raise errors.SpecError(
          f'gains and offset: {sorted(rows)} rows; allowed is one number, that'
          ' of the elements of the action'
      )
    (self._num_elements,) = rows
    self._offset = np.zeros(self._num_elements)
    if offset is not None:
      self._offset = np.array(offset, float)

  @property
  def num_elements(self) -> int:
    return self._num_elements

  @property
  def required_senses(self) -> tuple[str, ...]:
    return tuple(self._gains)

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    del key
    shape = np.shape(episode_start)
    action = np.broadcast_to(self._offset, (*shape, self._num_elements))
    for name, gain in self._gains.items():
      sense = np.reshape(observation[f'senses/{name}'], (*shape, -1))
      if sense.shape[-1] != gain.shape[1]:
        raise errors.SpecError(
            f'gains.{name}: {gain.shape[1]} columns; allowed is'
            f' {sense.shape[-1]}, the size of the sense'
        )
      # The same sums for one world and for many, to the last bit.
      action = action + (sense[..., np.newaxis, :] * gain).sum(axis=-1)
    return action, state

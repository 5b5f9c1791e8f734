"""Encoding of a learner's choices as actions of the environment."""

from collections.abc import Mapping
import dataclasses
import re
from typing import final

from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.policies import action_sets

_QUERY = 'query/'


@final
@dataclasses.dataclass(frozen=True)
class Controls:
  """Parsed form of an action spec.

  Attributes:
    shape: Shape of one world's action.
    dtype: Data type of actions.
    queries: Names of the query registers that an action writes. Their values
      are the first elements of the action.
    num_actions: Number of discrete actions; `None` if actions are vectors.
    action_set: The set of these actions; `None` if actions are vectors, or not
      those of a set.
    low: Lower bound of every element, including queries.
    high: Upper bound of every element, including queries.
  """

  shape: tuple[int, ...]
  dtype: np.dtype
  queries: tuple[str, ...]
  num_actions: int | None
  action_set: action_sets.ActionSet | None
  low: np.ndarray
  high: np.ndarray

  @classmethod
  def from_spec(cls, spec: specs.Array) -> 'Controls':
    """Parses an action spec.

    Raises:
      SpecError: If it is neither a `DiscreteArray` nor a one-dimensional array
        of numbers.
    """
    if isinstance(spec, specs.DiscreteArray):
      bounds = np.zeros(()), np.array(spec.num_values - 1.0)
      actions = _action_set(spec.name or '')
      return cls((), spec.dtype, (), spec.num_values, actions, *bounds)
    if spec.shape[1:] or not spec.shape or spec.dtype.kind not in 'if':
      raise errors.SpecError(
          f'action_spec: {spec!r:.120}; must be a DiscreteArray or a'
          ' one-dimensional array of numbers'
      )
    names = (spec.name or '').split('\t')
    queries = tuple(
        name.removeprefix(_QUERY) for name in names if name.startswith(_QUERY)
    )
    low, high = np.full(spec.shape, -np.inf), np.full(spec.shape, np.inf)
    if isinstance(spec, specs.BoundedArray):
      low = np.array(np.broadcast_to(spec.minimum, spec.shape), float)
      high = np.array(np.broadcast_to(spec.maximum, spec.shape), float)
    actions = None
    if len(queries) + 1 == spec.shape[0]:
      actions = _action_set(names[-1])
    num_actions = None if actions is None else len(actions)
    return cls(spec.shape, spec.dtype, queries, num_actions, actions, low, high)

  @property
  def size(self) -> int:
    """Size of a network's output: number of actions, or of elements."""
    if self.num_actions is not None:
      return self.num_actions
    return self.shape[0] - len(self.queries)

  def check_discrete(self, kind: str) -> None:
    """Checks that actions are indices, for a learner of some kind.

    Raises:
      SpecError: If they are vectors.
    """
    if self.num_actions is None:
      raise errors.SpecError(
          f'learner {kind!r}: actions are vectors of {self.size} elements;'
          ' the design must have an action_set'
      )

  def check_query(self, where: str, name: str) -> None:
    """Checks that a query register can hold the index of every action.

    Args:
      where: Name of the option that contains the register, for the message.
      name: Name of the register.

    Raises:
      SpecError: If there is no such query register, or it cannot hold every
        index.
    """
    if name not in self.queries:
      raise errors.SpecError(
          f'{where}: {name!r} is not a query register; this environment has'
          f' {list(self.queries)}'
      )
    i = self.queries.index(name)
    if self.low[i] > 0 or self.high[i] < self.size - 1:
      raise errors.SpecError(
          f'{where}: register {name!r} holds [{self.low[i]:g},'
          f' {self.high[i]:g}], which does not contain all actions from 0 to'
          f' {self.size - 1}'
      )

  def encode(
      self, chosen: np.ndarray, queries: Mapping[str, np.ndarray]
  ) -> np.ndarray:
    """Returns actions, `(worlds, *shape)`.

    Args:
      chosen: Indices of actions, `(worlds,)`; or elements, `(worlds, size)`,
        where [-1, 1] is scaled to the bounds and other values are clipped.
      queries: Values of query registers by name, each `(worlds,)`. Registers
        that are missing get the value nearest to 0.
    """
    if not self.shape:
      return chosen.astype(self.dtype)
    num_queries = len(self.queries)
    action = np.zeros((len(chosen), *self.shape))
    for i, name in enumerate(self.queries):
      action[:, i] = queries.get(name, 0.0)
    if self.num_actions is not None:
      action[:, -1] = chosen
    else:
      low, high = self.low[num_queries:], self.high[num_queries:]
      is_bounded = np.isfinite(low) & np.isfinite(high)
      middle = np.where(is_bounded, low + high, 0.0) / 2
      half = np.where(is_bounded, high - low, 2.0) / 2
      action[:, num_queries:] = middle + half * chosen
    return action.clip(self.low, self.high).astype(self.dtype)


def _action_set(name: str) -> action_sets.ActionSet | None:
  """Returns the action set of an element, or `None` without one.

  Args:
    name: Name of the element in the action spec, such as 'dmlab_like/v1'.
  """
  match = re.fullmatch(r'(\w+)/v(\d+)', name)
  return None if match is None else action_sets.get(match[1], int(match[2]))

"""Controls: how what a learner chooses becomes an action of the environment."""

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
  """An action spec, taken apart.

  Attributes:
    shape: Of one world's action.
    dtype: Of actions.
    queries: The names of the query registers that an action writes; they come
      first.
    num_actions: How many discrete actions there are, or `None`.
    low: The lowest value of every element, the queries' included.
    high: The highest value of every element.
  """

  shape: tuple[int, ...]
  dtype: np.dtype
  queries: tuple[str, ...]
  num_actions: int | None
  low: np.ndarray
  high: np.ndarray

  @classmethod
  def from_spec(cls, spec: specs.Array) -> 'Controls':
    """Takes an action spec apart.

    Raises:
      SpecError: If a learner cannot act by it.
    """
    if isinstance(spec, specs.DiscreteArray):
      bounds = np.zeros(()), np.array(spec.num_values - 1.0)
      return cls((), spec.dtype, (), spec.num_values, *bounds)
    if spec.shape[1:] or not spec.shape or spec.dtype.kind not in 'if':
      raise errors.SpecError(
          f'action_spec: {spec!r:.120}; allowed are a DiscreteArray and one'
          ' axis of numbers'
      )
    names = (spec.name or '').split('\t')
    queries = tuple(
        name.removeprefix(_QUERY) for name in names if name.startswith(_QUERY)
    )
    low, high = np.full(spec.shape, -np.inf), np.full(spec.shape, np.inf)
    if isinstance(spec, specs.BoundedArray):
      low = np.array(np.broadcast_to(spec.minimum, spec.shape), float)
      high = np.array(np.broadcast_to(spec.maximum, spec.shape), float)
    num_actions = None
    if len(queries) + 1 == spec.shape[0]:
      num_actions = _num_actions(names[-1])
    return cls(spec.shape, spec.dtype, queries, num_actions, low, high)

  @property
  def size(self) -> int:
    """How many numbers a network has to give: actions, or elements."""
    if self.num_actions is not None:
      return self.num_actions
    return self.shape[0] - len(self.queries)

  def check_discrete(self, kind: str) -> int:
    """Returns the number of actions.

    Raises:
      SpecError: If the actions are vectors.
    """
    if self.num_actions is None:
      raise errors.SpecError(
          f'learner {kind!r}: actions are vectors of {self.size} elements;'
          ' allowed is a design with an action_set'
      )
    return self.num_actions

  def check_query(self, where: str, name: str) -> None:
    """Checks that every action can be asked about in a query register.

    Raises:
      SpecError: If there is no such register, or not every index fits.
    """
    if name not in self.queries:
      raise errors.SpecError(
          f'{where}: {name!r} is no query register; this environment has'
          f' {list(self.queries)}'
      )
    i = self.queries.index(name)
    if self.low[i] > 0 or self.high[i] < self.size - 1:
      raise errors.SpecError(
          f'{where}: register {name!r} holds [{self.low[i]:g},'
          f' {self.high[i]:g}], which leaves out some of the actions 0 to'
          f' {self.size - 1}'
      )

  def encode(
      self, chosen: np.ndarray, asked: Mapping[str, np.ndarray]
  ) -> np.ndarray:
    """Returns actions, `(worlds, *shape)`.

    Args:
      chosen: Indices of actions, `(worlds,)`, or elements in [-1, 1] for the
        bounds, `(worlds, size)`. What is beyond them is cut off.
      asked: What goes into query registers, each `(worlds,)`. Others are left
        as near to 0 as they can be.
    """
    if not self.shape:
      return chosen.astype(self.dtype)
    num_queries = len(self.queries)
    action = np.zeros((len(chosen), *self.shape))
    for i, name in enumerate(self.queries):
      action[:, i] = asked.get(name, 0.0)
    if self.num_actions is not None:
      action[:, -1] = chosen
    else:
      low, high = self.low[num_queries:], self.high[num_queries:]
      is_bounded = np.isfinite(low) & np.isfinite(high)
      middle = np.where(is_bounded, low + high, 0.0) / 2
      half = np.where(is_bounded, high - low, 2.0) / 2
      action[:, num_queries:] = middle + half * chosen
    return action.clip(self.low, self.high).astype(self.dtype)


def _num_actions(name: str) -> int | None:
  """Returns the size of the action set that an element is an index into."""
  match = re.fullmatch(r'(\w+)/v(\d+)', name)
  if match is None:
    return None
  return len(action_sets.get(match[1], int(match[2])))

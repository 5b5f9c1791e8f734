"""Actions: what the agent may send, and how it reaches motors and queries."""

from collections.abc import Sequence
from typing import Any, final

from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.feedback import action_sets


@final
class ActionCodec:
  """Checks actions and takes them apart into queries and controls.

  Without a discrete action set, an action is one vector: the query elements,
  then the world's control elements. With one and no queries, it is the index of
  an action; with queries, a vector that ends in the index.
  """

  def __init__(
      self,
      control_spec: specs.BoundedArray,
      query_specs: Sequence[specs.BoundedArray],
      action_set: action_sets.ActionSet | None,
  ) -> None:
    """Makes the codec.

    Args:
      control_spec: What the world takes; element names are tab-separated.
      query_specs: What each query register stores.
      action_set: The discrete actions, or `None` for continuous ones.
    """
    self._num_queries = len(query_specs)
    self._table: np.ndarray | None = None
    names = [f'query/{spec.name}' for spec in query_specs]
    low = [float(spec.minimum) for spec in query_specs]
    high = [float(spec.maximum) for spec in query_specs]
    shape: tuple[int, ...] = (self._num_queries + control_spec.shape[0],)
    dtype: np.dtype[Any] = np.dtype(np.float64)
    if action_set is None:
      names += (control_spec.name or '').split('\t')
      low += list(np.broadcast_to(control_spec.minimum, control_spec.shape))
      high += list(np.broadcast_to(control_spec.maximum, control_spec.shape))
    else:
      elements = (control_spec.name or '').split('\t')
      self._table = action_set.table(
          tuple(name.rpartition('/')[2] for name in elements)
      )
      names.append(f'{action_set.name}/v{action_set.version}')
      low.append(0.0)
      high.append(len(action_set) - 1.0)
      shape = (self._num_queries + 1,)
      if not query_specs:
        shape, dtype = (), np.dtype(np.int32)
    self._names = names
    self._low, self._high = np.array(low), np.array(high)
    self._spec = self._make_spec(shape, dtype)

  def _make_spec(self, shape: tuple[int, ...], dtype: np.dtype) -> specs.Array:
    if not shape:
      return specs.DiscreteArray(
          int(self._high[0]) + 1, dtype=dtype, name=self._names[0]
      )
    return specs.BoundedArray(
        shape, dtype, self._low, self._high, name='\t'.join(self._names)
    )

  @property
  def spec(self) -> specs.Array:
    """The action spec; queries come first, as non-MuJoCo elements should."""
    return self._spec

  def decode(
      self, action: Any, batch_shape: tuple[int, ...] = ()
  ) -> tuple[np.ndarray, np.ndarray]:
    """Checks an action and takes it apart.

    Args:
      action: Shape `(*batch_shape, *spec.shape)`, of a safe numeric dtype.
      batch_shape: `()` for one world, `(worlds,)` for many.

    Returns:
      Query values, `(..., queries)`, and controls, `(..., controls)`.

    Raises:
      ActionError: If dtype, shape or any element is wrong.
    """
    values = self._cast(action)
    expected = (*batch_shape, *self._spec.shape)
    if values.shape != expected:
      raise errors.ActionError(
          f'action: shape {values.shape}, expected {expected}'
      )
    if not self._spec.shape:
      values = values[..., np.newaxis]
    good = (values >= self._low) & (values <= self._high)  # NaN is not.
    if self._table is not None:
      index = values[..., -1]
      good[..., -1] &= index == np.rint(index)
    if np.count_nonzero(good) != good.size:
      raise errors.ActionError(self._complaint(values, ~good))
    queries = values[..., : self._num_queries]
    controls = values[..., self._num_queries :]
    if self._table is not None:
      controls = self._table[controls[..., 0].astype(int)]
    return queries, controls

  def _cast(self, action: Any) -> np.ndarray:
    try:
      values = np.asarray(action)
    except Exception as error:  # An object may raise what it likes.
      raise errors.ActionError(
          f'action: {type(action).__name__} is no array of numbers'
      ) from error
    # A discrete action is an integer; half a step to the left is not one.
    kinds = 'iuf' if self._spec.shape else 'iu'
    if values.dtype.kind not in kinds:
      raise errors.ActionError(
          f'action: dtype {values.dtype}; expected' f' {self._spec.dtype}'
      )
    # What is too large for float64 becomes infinite, which no bounds allow.
    with np.errstate(over='ignore'):
      return values.astype(np.float64)

  def _complaint(self, values: np.ndarray, bad: np.ndarray) -> str:
    where = tuple(np.argwhere(bad)[0])
    value, i = values[where], where[-1]
    label = f'action{list(map(int, where))}' if self._spec.shape else 'action'
    if np.isnan(value):
      return f'{label} ({self._names[i]}) is nan'
    low, high = self._low[i], self._high[i]
    if low <= value <= high:
      return f'{label} ({self._names[i]}) = {value} is not a whole number'
    return f'{label} ({self._names[i]}) = {value} outside [{low:g}, {high:g}]'

"""Action specs, and the split of actions into queries and controls."""

from collections.abc import Sequence
from typing import Any, final

from dm_control import composer
from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs as feedback_specs
from realab_suite.policies import action_sets
from realab_suite.tasks import base

# Types of the number of an action; bool is another type than int.
_INTEGERS = int, np.int32, np.int64


@final
class ActionCodec:
  """Checks actions and splits them into queries and controls.

  Every action that satisfies `spec` is accepted:

  - Without a discrete action set, an action is one float64 vector: the query
    elements, then the task's control elements.
  - With an action set and no queries, it is the int32 index of an action.
  - With an action set and queries, it is a vector that ends in the index: int32
    if all queries are also indices of actions, and float64 if any query is a
    real number. In a float64 vector, the index is rounded to the nearest
    integer.
  """

  def __init__(
      self,
      spec: specs.BoundedArray,
      num_queries: int,
      table: np.ndarray | None,
  ) -> None:
    """Initializes the codec.

    Args:
      spec: Spec of actions; element names are tab-separated.
      num_queries: Number of queries with which they begin.
      table: Controls of each discrete action, `(actions, controls)`; `None` for
        continuous actions.
    """
    self._spec, self._num_queries, self._table = spec, num_queries, table
    self._shape = spec.shape
    self._names = spec.name.split('\t')
    self._low, self._high = (
        np.array(bound, float).reshape(-1)
        for bound in (spec.minimum, spec.maximum)
    )
    # An unbounded element accepts any finite number.
    self._is_bounded = bool(np.isfinite([self._low, self._high]).all())
    # None if actions are not just the number of an action.
    is_index = isinstance(spec, specs.DiscreteArray)
    self._table_of_indices = table if is_index else None
    # Floats are rejected where actions are integers, instead of rounded.
    self._kinds = 'iu' if spec.dtype.kind == 'i' else 'iuf'

  @property
  def spec(self) -> specs.Array:
    """Action spec. The queries come before the elements of the task."""
    return self._spec

  def decode(
      self, action: Any, batch_shape: tuple[int, ...] = ()
  ) -> tuple[np.ndarray, np.ndarray]:
    """Checks an action and splits it.

    Args:
      action: Array of shape `(*batch_shape, *spec.shape)`. It must contain
        integers if the dtype of `spec` is an integer type.
      batch_shape: `()` for one world, `(worlds,)` for a batch.

    Returns:
      The query values, `(..., queries)`, and the controls, `(..., controls)`,
      both float64.

    Raises:
      ActionError: If the dtype or the shape is wrong, or if an element is out
        of bounds or not finite.
    """
    table = self._table_of_indices
    if table is not None and type(action) in _INTEGERS and not batch_shape:
      # The usual case of one world, without the time of the other checks.
      if 0 <= action < len(table):
        return np.zeros(0), table[action].copy()
    values = self._cast(action)
    expected = (*batch_shape, *self._shape)
    if values.shape != expected:
      hint = (
          '; the number of an action needs a design or an override with an'
          ' action_set'
          if values.shape == batch_shape and self._table is None
          else ''
      )
      raise errors.ActionError(
          f'action: shape {values.shape}, expected {expected}{hint}'
      )
    if not self._shape:
      values = values[..., np.newaxis]
    is_valid = (values >= self._low) & (values <= self._high)  # False for NaN.
    if not self._is_bounded:
      is_valid &= np.isfinite(values)
    if np.count_nonzero(is_valid) != is_valid.size:
      raise errors.ActionError(self._bounds_message(values, ~is_valid))
    queries = values[..., : self._num_queries]
    controls = values[..., self._num_queries :]
    if self._table is not None:
      controls = self._table[np.rint(controls[..., 0]).astype(int)]
    return queries, controls

  def _cast(self, action: Any) -> np.ndarray:
    try:
      values = np.asarray(action)
    except Exception as error:  # `__array__` may raise anything.
      raise errors.ActionError(
          f'action: {type(action).__name__} is not an array of numbers'
      ) from error
    if values.dtype.kind not in self._kinds:
      raise errors.ActionError(
          f'action: dtype {values.dtype}; expected {self._spec.dtype}'
      )
    if isinstance(action, np.ma.MaskedArray):
      raise errors.ActionError('action: a masked array; expected plain numbers')
    if values.dtype == np.float64:
      return values.copy()
    # Numbers that overflow float64 become infinite and are rejected later.
    with np.errstate(over='ignore'):
      return values.astype(np.float64)

  def _bounds_message(self, values: np.ndarray, bad: np.ndarray) -> str:
    where = tuple(np.argwhere(bad)[0])
    value, i = values[where], where[-1]
    label = f'action{list(map(int, where))}' if self._shape else 'action'
    if np.isnan(value):
      return f'{label} ({self._names[i]}) is nan'
    low, high = self._low[i], self._high[i]
    return f'{label} ({self._names[i]}) = {value} outside [{low:g}, {high:g}]'


def _element_names(control_spec: Any) -> list[str]:
  """Returns the name of each control element.

  Raises:
    SpecError: If the spec is not a bounded vector of numbers.
  """
  is_vector = isinstance(control_spec, specs.BoundedArray) and (
      len(control_spec.shape) == 1 and control_spec.dtype.kind in 'iuf'
  )
  if not is_vector:
    raise errors.SpecError(
        f'action_spec of the task: {control_spec!r:.160}; must be a'
        ' BoundedArray of numbers with one axis'
    )
  names = (control_spec.name or '').split('\t')
  (num_elements,) = control_spec.shape
  if len(names) != num_elements:
    return [f'element_{i}' for i in range(num_elements)]
  return names


def action_set_of(
    task: composer.Task, design: feedback_specs.DesignSpec
) -> action_sets.ActionSet:
  """Returns the actions that policies choose from.

  Args:
    task: Task of this package, or a foreign one.
    design: Design whose action set counts; without one, that of the task.
  """
  spec = design.action_set
  if spec is not None:
    return action_sets.get(spec.name, spec.version)
  if isinstance(task, base.Task):
    return task.ACTION_SET
  return action_sets.DMLAB_LIKE


def for_design(
    control_spec: specs.BoundedArray, mechanism: mechanisms.FeedbackMechanism
) -> ActionCodec:
  """Returns the codec for the queries and the action set of a design.

  Args:
    control_spec: Action spec of the task; element names are tab-separated.
    mechanism: Mechanism that runs the design.

  Raises:
    SpecError: If the task's action spec is not a bounded vector of numbers.
  """
  elements = _element_names(control_spec)
  queries = [register.value_spec for register in mechanism.queries]
  names = [f'query/{spec.name}' for spec in queries]
  chosen = mechanism.design.action_set
  if chosen is None:
    spec = _vector(float, [*names, *elements], [*queries, control_spec])
    return ActionCodec(spec, len(queries), None)
  action_set = action_sets.get(chosen.name, chosen.version)
  table = action_set.table(tuple(name.rpartition('/')[2] for name in elements))
  index_name = f'{action_set.name}/v{action_set.version}'
  index = specs.DiscreteArray(len(table), dtype=np.int32, name=index_name)
  if not queries:
    return ActionCodec(index, 0, table)
  indices = mechanism.design.integer_queries()
  dtype = np.int32 if all(one.name in indices for one in queries) else float
  spec = _vector(dtype, [*names, index_name], [*queries, index])
  return ActionCodec(spec, len(queries), table)


def _vector(
    dtype: type, names: Sequence[str], parts: Sequence[specs.BoundedArray]
) -> specs.BoundedArray:
  """Returns the spec of a vector with the bounds of its parts."""
  low, high = (
      np.concatenate(
          [
              np.broadcast_to(getattr(part, bound), part.shape).ravel()
              for part in parts
          ]
      )
      for bound in ('minimum', 'maximum')
  )
  if dtype is np.int32:
    low, high = np.ceil(low), np.floor(high)
  return specs.BoundedArray(
      low.shape,
      dtype,
      low.astype(dtype),
      high.astype(dtype),
      name='\t'.join(names),
  )

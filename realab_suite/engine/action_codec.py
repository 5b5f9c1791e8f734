"""Action specs, and the split of actions into queries and controls."""

from collections.abc import Collection, Sequence
import math
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
      control_spec: specs.BoundedArray,
      query_specs: Sequence[specs.BoundedArray],
      action_set: action_sets.ActionSet | None,
      integer_queries: Collection[str] = (),
  ) -> None:
    """Initializes the codec.

    Args:
      control_spec: Action spec of the task; element names are tab-separated.
      query_specs: Value spec of each query register.
      action_set: Discrete actions, or `None` for continuous actions.
      integer_queries: Names of the query registers that contain the index of
        an action.

    Raises:
      SpecError: If the task's action spec is not a bounded vector of numbers.
    """
    elements = _element_names(control_spec)
    self._num_queries = len(query_specs)
    self._table: np.ndarray | None = None
    names = [f'query/{spec.name}' for spec in query_specs]
    low = [float(spec.minimum) for spec in query_specs]
    high = [float(spec.maximum) for spec in query_specs]
    is_integer = False
    if action_set is None:
      names += elements
      low += list(np.broadcast_to(control_spec.minimum, control_spec.shape))
      high += list(np.broadcast_to(control_spec.maximum, control_spec.shape))
    else:
      self._table = action_set.table(
          tuple(name.rpartition('/')[2] for name in elements)
      )
      names.append(f'{action_set.name}/v{action_set.version}')
      low.append(0.0)
      high.append(len(action_set) - 1.0)
      is_integer = all(spec.name in integer_queries for spec in query_specs)
    if is_integer:
      low, high = [math.ceil(x) for x in low], [math.floor(x) for x in high]
    self._names = names
    self._low, self._high = np.array(low, float), np.array(high, float)
    # An unbounded element accepts any finite number.
    self._is_bounded = bool(np.isfinite([self._low, self._high]).all())
    self._spec = self._make_spec(np.dtype(np.int32 if is_integer else float))
    self._shape = self._spec.shape
    # None if actions are not just the number of an action.
    is_index = isinstance(self._spec, specs.DiscreteArray)
    self._table_of_indices = self._table if is_index else None
    # Floats are rejected where actions are integers, instead of rounded.
    self._kinds = 'iu' if is_integer else 'iuf'

  def _make_spec(self, dtype: np.dtype) -> specs.Array:
    if self._table is not None and not self._num_queries:
      return specs.DiscreteArray(
          len(self._table), dtype=dtype, name=self._names[0]
      )
    return specs.BoundedArray(
        self._low.shape,
        dtype,
        self._low.astype(dtype),
        self._high.astype(dtype),
        name='\t'.join(self._names),
    )

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
    control_spec: Action spec of the task.
    mechanism: Mechanism that runs the design.
  """
  design = mechanism.design
  spec = design.action_set
  return ActionCodec(
      control_spec,
      [register.value_spec for register in mechanism.queries],
      spec and action_sets.get(spec.name, spec.version),
      design.integer_queries(),
  )

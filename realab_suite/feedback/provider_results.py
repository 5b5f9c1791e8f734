"""Checks of the writes and states that providers return."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite import errors
from realab_suite import trees
from realab_suite.config import messages
from realab_suite.entities import axes
from realab_suite.feedback import providers


@final
class RequestedWrite(NamedTuple):
  """A value that a provider writes.

  Attributes:
    value: The value, `(...)` float64.
    where: Worlds in which it is written, `(...)` bool; `None` for all worlds.
  """

  value: Any
  where: axes.Mask


def checked(
    provider: providers.Provider,
    returned: Any,
    batch_shape: tuple[int, ...],
) -> tuple[dict[str, RequestedWrite], Any]:
  """Returns the writes, by register, and the next state of a provider.

  Args:
    provider: The provider.
    returned: Result of its `step`.
    batch_shape: `()` for one world, `(worlds,)` for a batch.

  Raises:
    FeedbackProviderError: If the result does not match the declaration of the
      provider. The message does not contain the name of the provider.
  """
  if not isinstance(returned, tuple) or len(returned) != 2:
    raise errors.FeedbackProviderError(
        f'returned {messages.quote(returned)}; must be (writes, state)'
    )
  values, state = returned
  # Almost all are dicts, which the check for mappings is slow for.
  is_mapping = type(values) is dict or isinstance(values, Mapping)
  if not is_mapping or not values.keys() <= set(provider.writes):
    names = sorted(map(str, values)) if is_mapping else values
    raise errors.FeedbackProviderError(
        f'returned writes {messages.quote(names)}; it declares writes to'
        f' {sorted(provider.writes)}; must be a mapping from their names to'
        ' values'
    )
  return {
      name: _checked_write(name, value, batch_shape)
      for name, value in values.items()
  }, state


def joint(
    where: str, names: Sequence[str], writes: Mapping[str, RequestedWrite]
) -> RequestedWrite | None:
  """Returns the one write that sets all ports of a register.

  Args:
    where: Writer and step, for messages.
    names: Names of the ports.
    writes: Writes of the provider, by port.

  Returns:
    The write, with values `(..., ports)`; `None` if there is none.

  Raises:
    FeedbackProviderError: If only some of the ports are written in a world.
  """
  parts = [writes[name] for name in names if name in writes]
  if not parts:
    return None
  mask = parts[0].where
  if len(parts) < len(names) or not all(
      np.array_equal(
          True if one.where is None else one.where,
          True if mask is None else mask,
      )
      for one in parts
  ):
    raise errors.FeedbackProviderError(
        f'{where} wrote {[name for name in names if name in writes]}, or in'
        f' different worlds; allowed in each world are all of {list(names)}, or'
        ' none, because one write sets them all'
    )
  return RequestedWrite(np.stack([one.value for one in parts], axis=-1), mask)


def _checked_write(
    name: str, write: Any, shape: tuple[int, ...]
) -> RequestedWrite:
  """Returns a write, which is a value or a tuple of a value and a mask.

  Raises:
    FeedbackProviderError: If it is not, or if a shape differs from `shape`.
  """
  if not isinstance(write, tuple):
    return RequestedWrite(_checked_value(name, write, shape), None)
  mask = write[1] if len(write) == 2 else None
  if not isinstance(mask, bool | np.bool_ | np.ndarray) or (
      np.asarray(mask).dtype != bool or np.shape(mask) != shape
  ):
    raise errors.FeedbackProviderError(
        f'wrote {messages.quote(write)} to {name!r}; must be a value, or a'
        f' tuple (value, mask) with a mask of bool of shape {shape}'
    )
  return RequestedWrite(
      _checked_value(name, write[0], shape), np.asarray(mask)[()]
  )


def _checked_value(name: str, value: Any, shape: tuple[int, ...]) -> Any:
  """Returns a value to write as float64.

  Raises:
    FeedbackProviderError: If it is not an array of numbers of shape `shape`.
  """
  if type(value) is np.float64 and not shape:
    return value  # The usual case, without the time of the checks.
  try:
    number = np.asarray(value)
  except Exception as error:  # Objects may raise any class.
    raise errors.FeedbackProviderError(
        f'wrote {messages.quote(value)} to {name!r}:'
        f' {messages.exception(error)}'
    ) from error
  if number.dtype.kind not in 'iuf' or np.ma.isMaskedArray(value):
    raise errors.FeedbackProviderError(
        f'wrote {messages.quote(value)} to {name!r}; must be plain numbers'
    )
  if number.shape != shape:
    raise errors.FeedbackProviderError(
        f'wrote shape {number.shape} to {name!r}; must be {shape}'
    )
  return number.astype(np.float64)[()]


def check_state(where: str, state: Any, batch_shape: tuple[int, ...]) -> None:
  """Checks that every array in a provider's state has an axis of worlds.

  Args:
    where: Description of the provider, for messages.
    state: State for a batch of worlds.
    batch_shape: `(worlds,)`.

  Raises:
    FeedbackProviderError: If the state contains anything except tuples, lists
      and dicts of such arrays.
  """
  if isinstance(state, dict):
    for part in state.values():
      check_state(where, part, batch_shape)
  elif isinstance(state, tuple | list):
    for part in state:
      check_state(where, part, batch_shape)
  elif (
      not isinstance(state, np.ndarray)
      or state.dtype.hasobject
      or state.shape[:1] != batch_shape
  ):
    raise errors.FeedbackProviderError(
        f'{where}: its state contains {messages.quote(state)}; allowed in a'
        ' batch are tuples, lists and dicts of arrays whose first axis has'
        f' length {batch_shape[0]}'
    )


def merged(where: str, state: Any, other: Any, worlds: np.ndarray) -> Any:
  """Returns a provider's state for a batch with some worlds of another one.

  Args:
    where: Name of the state, for messages.
    state: State of all worlds; it is not modified.
    other: Other state of all worlds, such as the initial one.
    worlds: Worlds to take from the other state: indices, or `(worlds,)` bool.

  Raises:
    FeedbackProviderError: If the states have different structures.
  """
  rows = np.flatnonzero(worlds) if worlds.dtype == bool else worlds
  try:
    return trees.put(state, rows, trees.taken(other, rows))
  except (AttributeError, IndexError, TypeError, ValueError) as error:
    raise errors.FeedbackProviderError(
        f'{where}: {messages.quote(state)}; must have the structure of the'
        f' initial state, {messages.quote(other)}'
    ) from error

"""Checks of the writes and states that providers return."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.feedback import providers


def checked(
    provider: providers.Provider,
    returned: Any,
    batch_shape: tuple[int, ...],
) -> tuple[dict[str, np.ndarray], Any]:
  """Returns the writes, as float64, and the next state of a provider.

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
        f'returned {messages.quote(returned)}; allowed is (writes, state)'
    )
  values, state = returned
  # Almost all are dicts, which the check for mappings is slow for.
  is_mapping = type(values) is dict or isinstance(values, Mapping)
  if not is_mapping or values.keys() != set(provider.writes):
    given = sorted(map(str, values)) if is_mapping else values
    raise errors.FeedbackProviderError(
        f'returned writes {messages.quote(given)}; it declares writes to'
        f' {sorted(provider.writes)}'
    )
  return {
      name: _checked_value(name, value, batch_shape)
      for name, value in values.items()
  }, state


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
        f'wrote {messages.quote(value)} to {name!r}; allowed are plain numbers'
    )
  if number.shape != shape:
    raise errors.FeedbackProviderError(
        f'wrote shape {number.shape} to {name!r}; allowed is {shape}'
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


def restarted(where: str, state: Any, initial: Any, worlds: np.ndarray) -> Any:
  """Returns a provider's state for a batch with some worlds restarted.

  Args:
    where: Name of the state, for messages.
    state: Current state of all worlds; it is not modified.
    initial: Initial state of all worlds.
    worlds: Indices of the worlds that begin an episode.

  Raises:
    FeedbackProviderError: If the states have different structures.
  """
  is_same = type(state) is type(initial)
  if is_same and isinstance(state, dict) and state.keys() == initial.keys():
    return {
        key: restarted(f'{where}[{key!r}]', part, initial[key], worlds)
        for key, part in state.items()
    }
  is_sequence = is_same and isinstance(state, tuple | list)
  if is_sequence and len(state) == len(initial):
    return type(state)(
        restarted(f'{where}[{i}]', part, initial[i], worlds)
        for i, part in enumerate(state)
    )
  if np.shape(state) == np.shape(initial) and isinstance(initial, np.ndarray):
    result = np.array(state)
    result[worlds] = initial[worlds]
    return result
  raise errors.FeedbackProviderError(
      f'{where}: {messages.quote(state)}; allowed is the structure of the'
      f' initial state, {messages.quote(initial)}'
  )

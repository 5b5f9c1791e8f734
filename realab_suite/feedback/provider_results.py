"""Checks of what providers return: writes, and states of many worlds."""

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
  """Returns the writes and the next state that a provider returned.

  Args:
    provider: The provider.
    returned: Result of its `step`.
    batch_shape: `()` for one world, `(worlds,)` for many.

  Raises:
    FeedbackProviderError: If they are not what it declares; the message is to
      follow the name of the provider.
  """
  if not isinstance(returned, tuple) or len(returned) != 2:
    raise errors.FeedbackProviderError(
        f'returned {messages.quote(returned)}; allowed is (writes, state)'
    )
  values, state = returned
  if not isinstance(values, Mapping) or values.keys() != set(provider.writes):
    given = sorted(map(str, values)) if isinstance(values, Mapping) else values
    raise errors.FeedbackProviderError(
        f'returned writes {messages.quote(given)}; it declares writes to'
        f' {sorted(provider.writes)}'
    )
  return {
      name: _checked_value(name, value, batch_shape)
      for name, value in values.items()
  }, state


def _checked_value(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
  """Returns a value to write as float64, if it is one per world."""
  try:
    number = np.asarray(value)
  except Exception as error:  # An object may raise anything.
    raise errors.FeedbackProviderError(
        f'wrote {messages.quote(value)} to {name!r}: {type(error).__name__}:'
        f' {error}'
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
  """Checks that a provider's state in a batch has an axis of worlds throughout.

  Raises:
    FeedbackProviderError: If something else is in it.
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
        f'{where}: its state holds {messages.quote(state)}; allowed in a batch'
        ' are tuples, lists and dicts of arrays whose first axis has length'
        f' {batch_shape[0]}'
    )


def restarted(where: str, state: Any, initial: Any, worlds: np.ndarray) -> Any:
  """Returns a provider's state in a batch, with some worlds restarted.

  Args:
    where: Name of the state, for messages.
    state: The state; it is not written to.
    initial: The state before the first step, of as many worlds.
    worlds: Places of the worlds that begin an episode.

  Raises:
    FeedbackProviderError: If the structure of the two differs.
  """
  is_like = type(state) is type(initial)
  if is_like and isinstance(state, dict) and state.keys() == initial.keys():
    return {
        key: restarted(f'{where}[{key!r}]', part, initial[key], worlds)
        for key, part in state.items()
    }
  if is_like and isinstance(state, tuple | list) and len(state) == len(initial):
    return type(state)(
        restarted(f'{where}[{i}]', part, initial[i], worlds)
        for i, part in enumerate(state)
    )
  if np.shape(state) == np.shape(initial) and isinstance(initial, np.ndarray):
    begun = np.array(state)
    begun[worlds] = initial[worlds]
    return begun
  raise errors.FeedbackProviderError(
      f'{where}: {messages.quote(state)}; allowed is the structure of the'
      f' initial state, {messages.quote(initial)}'
  )

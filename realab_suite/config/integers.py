"""The check of integers that users give as arguments."""

import numbers
from typing import Any

from realab_suite import errors
from realab_suite.config import messages

LARGEST = 2**63 - 1
"""Largest number in result rows, which have 64 bits."""


def is_integer(given: Any) -> bool:
  """Returns True for an integer of Python or NumPy, and False for a bool."""
  return isinstance(given, numbers.Integral) and not isinstance(given, bool)


def check(
    name: str,
    given: Any,
    low: int,
    high: int | None = LARGEST,
    *,
    more: str = '',
    error: type[errors.RealabError] = errors.SpecError,
) -> int:
  """Returns an argument as an integer of Python.

  Args:
    name: Name of the argument, for the error message.
    given: Value of the argument.
    low: Smallest allowed value.
    high: Largest allowed value; `None` if there is none.
    more: Other allowed values, for the error message.
    error: Class of the error.

  Raises:
    RealabError: Of the class `error`, if it is not an integer in this range.
  """
  if is_integer(given) and low <= given and (high is None or given <= high):
    return int(given)
  limit = '' if high in (None, LARGEST) else f' to {high}'
  raise error(
      f'{name}: {messages.quote(given)}; must be an integer from'
      f' {low}{limit}{more}'
  )

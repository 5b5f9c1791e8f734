"""Reports of breaches, which all contracts share."""

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from realab_suite import trees


@final
class ContractError(AssertionError):
  """Part of a contract that a class does not keep."""


def require(condition: Any, breach: str) -> None:
  """Reports a breach of a contract.

  Args:
    condition: True if the contract is kept.
    breach: What is wrong, and what is demanded.

  Raises:
    ContractError: If the condition is not true.
  """
  if not condition:
    raise ContractError(breach)


def require_same(
    given: Mapping[str, Any], expected: Mapping[str, Any], breach: str
) -> None:
  """Reports arrays that are not equal, bit for bit.

  Args:
    given: Arrays by name.
    expected: Arrays by name.
    breach: What is wrong if they differ.

  Raises:
    ContractError: If a name, a shape, a dtype or a value differs.
  """
  require(
      given.keys() == expected.keys(),
      f'{breach}: {sorted(given)} instead of {sorted(expected)}',
  )
  for name, value in expected.items():
    array, wanted = np.asarray(given[name]), np.asarray(value)
    # To print arrays takes longer than to compare them.
    if not trees.are_equal(array, wanted):
      raise ContractError(
          f'{breach}: {name!r} is {array!s:.200}; it was {wanted!s:.200}'
      )

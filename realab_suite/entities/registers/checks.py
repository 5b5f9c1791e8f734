"""Refusals of values and of register kinds."""

from collections.abc import Sequence
import re
from typing import Any

import numpy as np

from realab_suite import errors


def check_ports(name: str, ports: Sequence[str]) -> None:
  """Checks the names of the ports of a register kind.

  Raises:
    SpecError: If they cannot be names of registers.
  """
  # They become parts of names in YAML, observations, files and flags.
  is_legal = all(re.fullmatch('[a-z0-9_]+', port) for port in ports)
  if isinstance(ports, str) or not is_legal or len(set(ports)) < len(ports):
    raise errors.SpecError(
        f'register {name!r}: PORTS: {ports!r}; allowed are different names of'
        ' lower-case letters, digits and underscores'
    )


def refusal(
    name: str,
    value: np.ndarray,
    is_wrong: np.ndarray,
    allowed: str,
    ports: Sequence[str] = (),
) -> errors.RegisterValueError:
  """Returns an error for the first wrong value.

  Args:
    name: Name of the register.
    value: Values, `(...)`, or `(..., ports)`.
    is_wrong: True for each wrong value, bool of the same shape.
    allowed: Description of the allowed values.
    ports: Names of the ports of the register.
  """
  first = np.unravel_index(int(np.argmax(is_wrong)), np.shape(value))
  worlds = first[:-1] if ports else first
  if ports:
    name = f'{name}_{ports[int(first[-1])]}'
  return errors.RegisterValueError(
      f'register {name!r}: cannot store {np.asarray(value)[first]}; {allowed}',
      int(worlds[0]) if worlds else None,
  )


def misreading(
    register: Any, method: str, value: np.ndarray, expected: np.ndarray
) -> errors.SpecError:
  """Returns an error for what a register kind has returned.

  Args:
    register: The register.
    method: Name of the method that returned a wrong value.
    value: What it returned.
    expected: A value of the right shape.
  """
  ports = f', with its ports {list(register.PORTS)}' if register.PORTS else ''
  return errors.SpecError(
      f'register kind {type(register).__name__}: {method} of register'
      f' {register.name!r} returned {value.dtype} {value.shape}; allowed is'
      f' float64 {expected.shape}{ports}'
  )

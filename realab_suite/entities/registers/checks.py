"""Checks of values and of register kinds."""

from collections.abc import Callable, Sequence
import re
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.entities import protocols


def check_ports(name: str, ports: Sequence[str]) -> None:
  """Checks the names of the ports of a register kind.

  Raises:
    SpecError: If they cannot be names of registers.
  """
  # They become parts of names in YAML, observations, files and flags.
  is_legal = all(re.fullmatch('[a-z0-9_]+', port) for port in ports)
  if isinstance(ports, str) or not is_legal or len(set(ports)) < len(ports):
    raise errors.SpecError(
        f'register {name!r}: PORTS: {ports!r}; must be different names of'
        ' lower-case letters, digits and underscores'
    )


def refuse_infinite(value: np.ndarray, name: str, ports: Sequence[str]) -> None:
  """Refuses values that are not finite.

  Args:
    value: Values, `(...)`, or `(..., ports)`.
    name: Name of the register.
    ports: Names of its ports.

  Raises:
    RegisterValueError: If a value is not finite.
  """
  is_finite = np.isfinite(value)
  if is_finite.all():
    return
  first = np.unravel_index(int(np.argmin(is_finite)), np.shape(value))
  worlds = first[:-1] if ports else first
  if ports:
    name = f'{name}_{ports[int(first[-1])]}'
  raise errors.RegisterValueError(
      f'register {name!r}: cannot store {np.asarray(value)[first]}; must be'
      ' finite',
      int(worlds[0]) if worlds else None,
  )


def start_value(
    name: str,
    measure: Callable[[protocols.Physics], Any],
    physics: protocols.Physics,
    shape: tuple[int, ...],
) -> np.ndarray:
  """Returns the value of a register at the start of an episode.

  Args:
    name: Name of the register.
    measure: Function of the task that returns it.
    physics: One world or a batch of worlds.
    shape: Shape of the value.

  Raises:
    RegisterValueError: If the function fails or returns another shape.
  """
  try:
    value = np.asarray(measure(physics), np.float64)
    return np.broadcast_to(value, shape)
  except Exception as error:  # The function is a task's.
    raise errors.RegisterValueError(
        f'register {name!r}: the function of its initial value:'
        f' {type(error).__name__}: {error}; must be numbers of the shape'
        f' {shape}'
    ) from error


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
      f' {register.name!r} returned {value.dtype} {value.shape}; must be'
      f' float64 {expected.shape}{ports}'
  )

"""Allowed arguments and values of registers."""

from collections.abc import Sequence
import re
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite.entities import appearance

# embedded: the poses of the blocks store the value; blocks can be pushed.
# welded: the poses of the blocks store the value; only writes move the blocks.
# secure: a slot of the state stores the value; the blocks are scenery.
CHANNELS = ('embedded', 'welded', 'secure')
DOFS = ('free', 'planar')
OVERFLOWS = ('saturate', 'error')
# axis: a write sets only the coordinate that carries the value.
# pose: a write restores the whole pose of the written blocks.
WRITES = ('axis', 'pose')


def check(
    name: str,
    value_range: Sequence[float],
    scale: float,
    initial: float,
    role: str,
    channel: str,
    dof: str,
    on_overflow: str,
    write: str,
    ports: Sequence[str],
) -> None:
  """Checks the arguments of `Register`.

  Raises:
    SpecError: If an argument has a value that is not allowed.
  """
  allowed = (
      ('role', role, tuple(appearance.ROLE_COLOURS)),
      ('channel', channel, CHANNELS),
      ('dof', dof, DOFS),
      ('on_overflow', on_overflow, OVERFLOWS),
      ('write', write, WRITES),
  )
  for argument, value, choices in allowed:
    if value not in choices:
      raise errors.SpecError(
          f'register {name!r}: {argument}: {value!r}; allowed are'
          f' {list(choices)}'
      )
  if len(value_range) != 2 or not value_range[0] < value_range[1]:
    raise errors.SpecError(
        f'register {name!r}: value_range: {value_range!r}; allowed are two'
        ' numbers, low < high'
    )
  low, high = value_range
  if not (np.isfinite(low) and np.isfinite(high) and low <= initial <= high):
    raise errors.SpecError(
        f'register {name!r}: initial {initial!r} and value_range'
        f' {value_range!r}; both must be finite, with initial in value_range'
    )
  if not (np.isfinite(scale) and scale > 0):
    raise errors.SpecError(
        f'register {name!r}: scale: {scale!r}; allowed are numbers above 0'
    )
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

"""Designs for tasks whose actions are vectors: one register per element.

They are mappings, as `suite.load` and `suite.embed` take them. A register is
named after the element's index, because names of actuators may be anything.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors

# Distance between neighbouring registers, in m. Two-block registers with the
# default `block_size` are 0.45 m wide.
_SPACING = 0.6
# Bounds of an element that is unbounded.
_UNBOUNDED = 1.0
# Largest displacement that represents an element, in m.
_REACH = 0.4


def demonstration(
    action_spec: Any,
    controller: str,
    options: Mapping[str, Any] | None = None,
    place: Sequence[float] = (2.0, 2.0),
    **register: Any,
) -> dict[str, Any]:
  """Returns a design with a demonstrator of continuous actions.

  Args:
    action_spec: Action spec of the task, a `BoundedArray` of shape
      `(elements,)`.
    controller: Name of a registered controller.
    options: Keyword arguments of the controller.
    place: Place of the register `demonstration_0`, `(x, y)`, in m. The others
      are beside it, in the direction of the y axis.
    **register: Further fields of each register, such as `scale`.

  Raises:
    SpecError: If the action spec is not one of vectors.
  """
  registers = _registers(
      'demonstration', 'feedback', action_spec, place, register
  )
  provider = {
      'kind': 'continuous_demonstration',
      'controller': controller,
      'options': dict(options or {}),
      'writes': list(registers),
  }
  return _design('continuous_demonstration', registers, provider)


def advice(
    action_spec: Any,
    controller: str,
    options: Mapping[str, Any] | None = None,
    place: Sequence[float] = (2.0, 2.0),
    **register: Any,
) -> dict[str, Any]:
  """Returns a design with advice on continuous actions.

  The agent's action begins with the query: one value for each element of the
  action in question. The register `advice` contains its value, from -1 to 1.

  Args:
    action_spec: As in `demonstration`.
    controller: As in `demonstration`.
    options: As in `demonstration`.
    place: Place of the register `advice`, `(x, y)`, in m. The registers
      `query_0`, `query_1` ... are beside it, in the direction of the y axis.
    **register: As in `demonstration`.

  Raises:
    SpecError: If the action spec is not one of vectors.
  """
  x, y = place
  queries = _registers(
      'query', 'query', action_spec, (x, y + _SPACING), register
  )
  ranges = np.array([one['range'] for one in queries.values()])
  registers = {
      'advice': {
          'kind': 'two_block', 'role': 'feedback', 'place': [x, y],
          'range': [-1.0, 1.0], 'scale': _REACH, **register,
      },
      **queries,
  }  # fmt: skip
  provider = {
      'kind': 'continuous_advice',
      'controller': controller,
      'options': dict(options or {}),
      'reads': list(queries),
      'writes': ['advice'],
      'farthest': float(np.linalg.norm(ranges[:, 1] - ranges[:, 0])),
  }
  return _design('continuous_advice', registers, provider)


def action(
    observation: Mapping[str, np.ndarray], action_spec: Any
) -> np.ndarray:
  """Returns the action that the readings of an observation demonstrate.

  Args:
    observation: Observation of the agent; leading axes are worlds.
    action_spec: Action spec of the task.

  Returns:
    Action within the bounds of the spec, `(..., elements)`. A reading beyond
    them, which only corruption causes, is cut off.

  Raises:
    SpecError: If the action spec is not one of vectors.
  """
  low, high = _bounds(action_spec)
  readings = [
      observation[f'registers/demonstration_{i}'] for i in range(len(low))
  ]
  return np.clip(np.stack(readings, axis=-1), low, high)


def _design(
    name: str, registers: dict[str, Any], provider: dict[str, Any]
) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': name,
      'registers': registers,
      'providers': [provider],
  }


def _registers(
    name: str,
    role: str,
    action_spec: Any,
    place: Sequence[float],
    register: Mapping[str, Any],
) -> dict[str, Any]:
  """Returns a register for each element of an action, by name."""
  x, y = place
  low, high = _bounds(action_spec)
  return {
      f'{name}_{i}': {
          'kind': 'two_block',
          'role': role,
          'place': [x, y + i * _SPACING],
          'range': [float(low[i]), float(high[i])],
          'initial': float(np.clip(0.0, low[i], high[i])),
          'scale': _REACH / float(np.abs([low[i], high[i]]).max()),
          **register,
      }
      for i in range(len(low))
  }


def _bounds(action_spec: Any) -> tuple[np.ndarray, np.ndarray]:
  """Returns the bounds of each element, finite ones where there are none.

  Raises:
    SpecError: If the action spec is not one of vectors.
  """
  if not isinstance(action_spec, dm_env_specs.BoundedArray) or (
      len(action_spec.shape) != 1 or action_spec.dtype.kind != 'f'
  ):
    raise errors.SpecError(
        f'action_spec: {action_spec!r:.160}; allowed is a BoundedArray of real'
        ' numbers with one axis'
    )
  low = np.broadcast_to(action_spec.minimum, action_spec.shape)
  high = np.broadcast_to(action_spec.maximum, action_spec.shape)
  return (
      np.where(np.isfinite(low), low, -_UNBOUNDED),
      np.where(np.isfinite(high), high, _UNBOUNDED),
  )

"""Conversion of specs, observations and actions to dm_env_rpc messages.

The size of an observation's message does not depend on its values, so it cannot
carry information.
"""

from collections.abc import Mapping
import math
from typing import Any, final

from dm_env import specs
from dm_env_rpc.v1 import dm_env_rpc_pb2
from dm_env_rpc.v1 import dm_env_utils
from dm_env_rpc.v1 import tensor_utils
import numpy as np

from realab_suite import errors
from realab_suite.interop.rpc import refusals

ACTION = 1
"""Uid of the action."""

# Integer types whose encoded size depends on the value.
_VARINTS = (np.int32, np.int64, np.uint32, np.uint64)
_LARGEST_OF_ONE_BYTE = 127

Tensors = Mapping[int, dm_env_rpc_pb2.Tensor]


@final
class Observations:
  """Converts observations to tensors, whose size is constant for each name."""

  def __init__(self, spec: Mapping[str, specs.Array]) -> None:
    """Numbers the observations from 1, in the order of the spec.

    Args:
      spec: Observation spec.

    Raises:
      SpecError: If the size of an observation's message would depend on its
        value.
    """
    for name, one in spec.items():
      _refuse_varying_size(name, one)
    self._names = dict(enumerate(spec, start=1))
    self.specs = {
        uid: dm_env_utils.dm_env_spec_to_tensor_spec(
            spec[name].replace(name=name)
        )
        for uid, name in self._names.items()
    }

  def check(self, uids: Any) -> list[int]:
    """Returns the requested uids without duplicates, in ascending order.

    Raises:
      RequestRefused: If a uid is unknown.
    """
    # Remove duplicates first: a request may repeat one uid a million times.
    requested = set(uids)
    for uid in sorted(requested - self._names.keys()):
      raise refusals.RequestRefused(refusals.Reason.OBSERVATION, uid)
    return sorted(requested)

  def pack(
      self, observation: Mapping[str, np.ndarray], uids: list[int]
  ) -> dict[int, dm_env_rpc_pb2.Tensor]:
    """Returns the observations with the given uids as tensors, by uid."""
    return {
        uid: tensor_utils.pack_tensor(observation[self._names[uid]])
        for uid in uids
    }


@final
class Actions:
  """Reads actions from tensors, and checks their headers before unpacking."""

  def __init__(self, spec: specs.Array) -> None:
    self._spec = spec
    self.size = math.prod(spec.shape)
    self._payload = tensor_utils.get_packer(spec.dtype).name
    self._low, self._high = _bounds(spec)
    self.specs = {ACTION: dm_env_utils.dm_env_spec_to_tensor_spec(spec)}

  def read(self, tensors: Tensors) -> np.ndarray:
    """Returns the action of a request.

    Args:
      tensors: Tensors of the request, by uid.

    Raises:
      RequestRefused: If the action is missing or does not satisfy its spec.
    """
    for uid in sorted(tensors):
      if uid != ACTION:
        raise refusals.RequestRefused(refusals.Reason.ACTION, uid)
    if ACTION not in tensors:
      raise refusals.RequestRefused(refusals.Reason.NO_ACTION, ACTION)
    tensor = tensors[ACTION]
    payload = tensor.WhichOneof('payload')
    if payload != self._payload:
      raise refusals.RequestRefused(refusals.Reason.TYPE, ACTION)
    elements = getattr(tensor, payload).array
    # Shapes may be huge or negative, so only compare them.
    is_alike = (
        len(elements) == self.size
        and len(tensor.shape) == len(self._spec.shape)
        and tuple(tensor.shape) == self._spec.shape
    )
    if not is_alike:
      raise refusals.RequestRefused(refusals.Reason.SHAPE, ACTION)
    values = tensor_utils.unpack_proto(tensor)
    good = (values >= self._low) & (values <= self._high)  # False for nan.
    if not good.all():
      first = int(np.argmin(good))
      raise refusals.RequestRefused(refusals.Reason.VALUE, ACTION, first)
    return values.reshape(self._spec.shape)


def _bounds(spec: specs.Array) -> tuple[np.ndarray, np.ndarray]:
  """Returns the lower and the upper bound of each element, flattened."""
  if not isinstance(spec, specs.BoundedArray):
    raise errors.SpecError(f'action: {spec}; allowed are bounded arrays')
  low = np.broadcast_to(spec.minimum, spec.shape).ravel()
  high = np.broadcast_to(spec.maximum, spec.shape).ravel()
  return low, high


def _refuse_varying_size(name: str, spec: specs.Array) -> None:
  """Checks that the encoded size of an observation is constant.

  Raises:
    SpecError: If it depends on the value.
  """
  if spec.dtype.type not in _VARINTS:
    return
  is_bounded = isinstance(spec, specs.BoundedArray) and (
      np.min(spec.minimum) >= 0 and np.max(spec.maximum) <= _LARGEST_OF_ONE_BYTE
  )
  if not is_bounded:
    raise errors.SpecError(
        f'observation {name}: the encoded size of {spec.dtype} would depend on'
        ' its value; allowed are floats, bools, 8-bit integers, and other'
        f' integers with bounds in [0, {_LARGEST_OF_ONE_BYTE}]'
    )

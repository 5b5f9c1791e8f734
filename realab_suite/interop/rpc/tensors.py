"""Specs, observations and actions as messages whose size says nothing."""

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
"""The uid of the action."""

# An integer of these types takes as many bytes on the wire as its value needs.
_VARINTS = (np.int32, np.int64, np.uint32, np.uint64)
_LARGEST_OF_ONE_BYTE = 127

Tensors = Mapping[int, dm_env_rpc_pb2.Tensor]


@final
class Observations:
  """Turns observations into tensors; those of a name always have one size."""

  def __init__(self, spec: Mapping[str, specs.Array]) -> None:
    """Numbers the observations, from 1 on, in the order of the spec.

    Raises:
      SpecError: If the size of an observation would depend on its value.
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
    """Returns the uids that are asked for, each once.

    Raises:
      RequestRefused: If one is unknown.
    """
    # Not one by one: a request may ask for one of them a million times.
    asked = set(uids)
    for uid in sorted(asked - self._names.keys()):
      raise refusals.RequestRefused(refusals.Reason.OBSERVATION, uid)
    return sorted(asked)

  def pack(
      self, observation: Mapping[str, np.ndarray], uids: list[int]
  ) -> dict[int, dm_env_rpc_pb2.Tensor]:
    """Returns some observations as tensors, by uid."""
    return {
        uid: tensor_utils.pack_tensor(observation[self._names[uid]])
        for uid in uids
    }


@final
class Actions:
  """Reads actions; nothing is unpacked before its header has been checked."""

  def __init__(self, spec: specs.Array) -> None:
    self._spec = spec
    self.size = math.prod(spec.shape)
    self._payload = tensor_utils.get_packer(spec.dtype).name
    self._low, self._high = _bounds(spec)
    self.specs = {ACTION: dm_env_utils.dm_env_spec_to_tensor_spec(spec)}

  def read(self, tensors: Tensors) -> np.ndarray:
    """Returns the action that is in a request.

    Raises:
      RequestRefused: If it is none that the spec allows.
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
    # Shapes may be as large as they like, or negative: they are compared.
    is_alike = (
        len(elements) == self.size
        and len(tensor.shape) == len(self._spec.shape)
        and tuple(tensor.shape) == self._spec.shape
    )
    if not is_alike:
      raise refusals.RequestRefused(refusals.Reason.SHAPE, ACTION)
    values = tensor_utils.unpack_proto(tensor)
    good = (values >= self._low) & (values <= self._high)  # NaN is not.
    if not good.all():
      first = int(np.argmin(good))
      raise refusals.RequestRefused(refusals.Reason.VALUE, ACTION, first)
    return values.reshape(self._spec.shape)


def _bounds(spec: specs.Array) -> tuple[np.ndarray, np.ndarray]:
  """Returns the least and the largest value of each element, flattened."""
  if not isinstance(spec, specs.BoundedArray):
    raise errors.SpecError(f'action: {spec}; allowed are bounded arrays')
  low = np.broadcast_to(spec.minimum, spec.shape).ravel()
  high = np.broadcast_to(spec.maximum, spec.shape).ravel()
  return low, high


def _refuse_varying_size(name: str, spec: specs.Array) -> None:
  """Refuses integers that need more bytes the larger they are."""
  if spec.dtype.type not in _VARINTS:
    return
  is_bounded = isinstance(spec, specs.BoundedArray) and (
      np.min(spec.minimum) >= 0 and np.max(spec.maximum) <= _LARGEST_OF_ONE_BYTE
  )
  if not is_bounded:
    raise errors.SpecError(
        f'observation {name}: {spec.dtype} whose size on the wire would depend'
        ' on its value; allowed are floats, bools, 8-bit integers, and others'
        f' that are bounded to [0, {_LARGEST_OF_ONE_BYTE}]'
    )

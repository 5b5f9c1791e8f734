"""Conversion of specs, observations and actions to dm_env_rpc messages."""

from collections.abc import Mapping
from typing import Any, final

from dm_env import specs
from dm_env_rpc.v1 import dm_env_rpc_pb2
from dm_env_rpc.v1 import dm_env_utils
from dm_env_rpc.v1 import tensor_utils
import numpy as np

from realab_suite.doors.served import refusals

ACTION = 1
"""Uid of the action."""

Tensors = Mapping[int, dm_env_rpc_pb2.Tensor]


@final
class Observations:
  """Converts observations to tensors."""

  def __init__(self, spec: Mapping[str, specs.Array]) -> None:
    """Numbers the observations from 1, in the order of the spec."""
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
    requested = sorted(set(uids))
    for uid in requested:
      if uid not in self._names:
        raise refusals.RequestRefused(refusals.Reason.OBSERVATION, uid)
    return requested

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
  """Reads actions from tensors."""

  def __init__(self, spec: specs.Array) -> None:
    self._shape = spec.shape
    self._payload = tensor_utils.get_packer(spec.dtype).name
    self.specs = {ACTION: dm_env_utils.dm_env_spec_to_tensor_spec(spec)}

  def read(self, tensors: Tensors) -> np.ndarray:
    """Returns the action of a request, whose values are not checked yet.

    Args:
      tensors: Tensors of the request, by uid.

    Raises:
      RequestRefused: If the action is missing, or its type or shape is wrong.
    """
    for uid in sorted(tensors):
      if uid != ACTION:
        raise refusals.RequestRefused(refusals.Reason.ACTION, uid)
    if ACTION not in tensors:
      raise refusals.RequestRefused(refusals.Reason.NO_ACTION, ACTION)
    tensor = tensors[ACTION]
    # One element may stand for any number: compare the shape, then unpack.
    is_alike = (
        tensor.WhichOneof('payload') == self._payload
        and len(tensor.shape) == len(self._shape)
        and all(
            sent in (-1, size)
            for sent, size in zip(tensor.shape, self._shape, strict=True)
        )
    )
    try:
      if is_alike:
        return np.asarray(tensor_utils.unpack_tensor(tensor))
    except ValueError:  # The number of elements does not fit.
      pass
    raise refusals.RequestRefused(refusals.Reason.OTHER_SPEC, ACTION)

"""Wrappers that show a learner earlier steps: images, or a memory's state."""

from collections.abc import Mapping
import functools
from typing import Any, final

import jax
import numpy as np

from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import jax_settings
from realab_suite.lab.agents import networks


@final
class FrameStack(base.Wrapper):
  """Stacks the last images of an episode on channels, the newest last.

  Copies of the first image of an episode stand for those before it.
  """

  NAME = 'frame_stack'

  def __init__(self, number: int, learner: base.Learner) -> None:
    self._number = number
    self._names = tuple(learner.setting.encoder.image_shapes)

  def see(
      self,
      observation: dict[str, Any],
      is_first: np.ndarray,
      earlier: Mapping[str, np.ndarray] | None,
  ) -> dict[str, Any]:
    stacked = dict(observation)
    for name in self._names:
      image = np.asarray(observation[name])
      copies = np.concatenate([image] * self._number, axis=-1)
      if earlier is not None:
        later = np.concatenate(
            [earlier[name][..., image.shape[-1] :], image], axis=-1
        )
        is_new = is_first[:, np.newaxis, np.newaxis, np.newaxis]
        copies = np.where(is_new, copies, later)
      stacked[name] = copies
    return stacked


@final
class MemoryState(base.Wrapper):
  """Hands on the state of the recurrent memory of a policy.

  An observation has the state before it, which is 0 where an episode begins.
  """

  NAME = 'memory'

  def __init__(self, units: int, learner: base.Learner) -> None:
    self._units = units
    self._learner = learner
    self._encoder = learner.setting.encoder.with_memory(units)

  @jax_settings.pinned()
  def see(
      self,
      observation: dict[str, Any],
      is_first: np.ndarray,
      earlier: Mapping[str, np.ndarray] | None,
  ) -> dict[str, Any]:
    state = np.zeros((len(is_first), self._units), np.float32)
    if earlier is not None:
      packed = self._encoder.pack(earlier, len(is_first))
      memory = self._learner.networks[0].memory
      later = np.asarray(_remember(self._encoder, memory, packed))
      state = np.where(is_first[:, np.newaxis], state, later)
    return {**observation, features.MEMORY: state}


@functools.partial(jax.jit, static_argnums=0)
def _remember(
    encoder: features.Encoder,
    memory: networks.Memory,
    observation: features.Packed,
) -> jax.Array:
  """Returns the state of a memory after an observation, `(worlds, units)`."""
  return memory.state(memory(encoder.encode(observation)))

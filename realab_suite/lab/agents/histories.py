"""Wrapper that shows a learner earlier images."""

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from realab_suite.lab.agents import base


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

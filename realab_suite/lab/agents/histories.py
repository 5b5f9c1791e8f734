"""Wrappers that show a learner what was earlier in an episode."""

from collections.abc import Mapping
from typing import Any, final

from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.lab.agents import base
from realab_suite.policies import recollections


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
class Recollection(base.Wrapper):
  """Adds what `recollections` remembers of the reading that is learned from.

  Its memory is in the observation, so that a learner's state contains it.
  """

  NAME = 'recollection'

  def __init__(self, is_wanted: bool, learner: base.Learner) -> None:
    del is_wanted  # There is no wrapper otherwise.
    self._reading = learner.reading
    self._key = recollections.key_of(learner.reading)

  def see(
      self,
      observation: dict[str, Any],
      is_first: np.ndarray,
      earlier: Mapping[str, np.ndarray] | None,
  ) -> dict[str, Any]:
    before = (
        recollections.initial(is_first.shape)
        if earlier is None
        else earlier[self._key]
    )
    now = recollections.recall(observation, self._reading, is_first, before)
    return {**observation, self._key: now}


def recollected(
    observation_spec: Mapping[str, specs.Array], reading: str
) -> dict[str, specs.Array]:
  """Returns the spec of observations with a recollection.

  Args:
    observation_spec: Observation spec of one world.
    reading: Key of the reading that is remembered.

  Raises:
    SpecError: If it lacks the senses of which a recollection is made.
  """
  missing = [key for key in recollections.SENSES if key not in observation_spec]
  if missing:
    raise errors.SpecError(
        'learner.recollection: true; must be false without the senses'
        f' {missing}: an agent that does not know where it is cannot remember'
        ' where it was'
    )
  size = len(recollections.NUMBERS)
  added = specs.Array((size,), np.float32)
  return {**observation_spec, recollections.key_of(reading): added}

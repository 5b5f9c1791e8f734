"""Time steps of a batch of worlds."""

from typing import NamedTuple, Self, final

import dm_env
import numpy as np


@final
class BatchTimeStep(NamedTuple):
  """Like `dm_env.TimeStep`, with a leading axis of worlds.

  Attributes:
    step_type: Step type of each world, `(worlds,)` int: 0 is the first step of
      an episode, 1 a middle step and 2 the last; see `dm_env.StepType`.
    reward: `(worlds,)`. Always 0.0, because there is no reward channel.
    discount: Discount of each world, `(worlds,)`; 1.0 in first steps.
    observation: Arrays of shape `(worlds, ...)`, by name.
  """

  step_type: np.ndarray
  reward: np.ndarray
  discount: np.ndarray
  observation: dict[str, np.ndarray]

  def first(self) -> np.ndarray:
    """Returns the mask of the worlds in a first step, `(worlds,)` bool."""
    return np.asarray(self.step_type == int(dm_env.StepType.FIRST))

  def mid(self) -> np.ndarray:
    """Returns the mask of the worlds in a middle step, `(worlds,)` bool."""
    return np.asarray(self.step_type == int(dm_env.StepType.MID))

  def last(self) -> np.ndarray:
    """Returns the mask of the worlds in a last step, `(worlds,)` bool."""
    return np.asarray(self.step_type == int(dm_env.StepType.LAST))

  def take(self, worlds: np.ndarray) -> Self:
    """Returns the time steps of some worlds, as copies.

    Args:
      worlds: Indices of the worlds, `(indices,)` int.
    """
    return self._replace(
        step_type=self.step_type[worlds],
        reward=self.reward[worlds],
        discount=self.discount[worlds],
        observation={k: v[worlds] for k, v in self.observation.items()},
    )

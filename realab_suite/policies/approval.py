"""Approval: how near an action is to what some policy would do here."""

from collections.abc import Mapping
from typing import Annotated, Any, final

import numpy as np

from realab_suite.config import option_types
from realab_suite.entities import avatars
from realab_suite.policies import action_sets
from realab_suite.policies import base


@base.VALUE_FUNCTIONS.add('apple_seeker_approval')
@final
class PolicyApproval(base.ValueFunction):
  """Values actions from 1, for the policy's own, down to no less than -1.

  The value falls with the distance from the policy's action, as vectors of the
  avatar's control elements: nearly right is better than wrong.
  """

  def __init__(
      self,
      policy: Annotated[
          str, option_types.NameIn(base.POLICIES)
      ] = 'apple_seeker',
      options: Annotated[
          Mapping[str, Any] | None,
          option_types.OptionsOf(base.POLICIES, 'policy'),
      ] = None,
  ) -> None:
    """Makes the value function.

    Args:
      policy: The name of a registered policy.
      options: Keyword arguments of the policy.
    """
    self._policy = base.make(policy, **(options or {}))
    controls = self.action_set.table(avatars.ACTIONS)
    distances = np.linalg.norm(controls[:, np.newaxis] - controls, axis=-1)
    self._values = 1.0 - 2.0 * distances / distances.max()

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._policy.action_set

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return self._policy.initial_state(batch_shape)

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    action, state = self._policy.step(observation, episode_start, key, state)
    return self._values[action], state

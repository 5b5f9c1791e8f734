"""Approval: value functions from the action that a policy would take."""

from collections.abc import Mapping
from typing import Annotated, Any, final

import numpy as np

from realab_suite.config import option_types
from realab_suite.entities import avatars
from realab_suite.policies import base


@base.VALUE_FUNCTIONS.add('apple_seeker_approval')
@final
class PolicyApproval(base.Follower, base.ValueFunction):
  """Values actions by their distance from the action of a policy.

  The value of the policy's own action is 1. It falls with the distance between
  control vectors of the avatar, to -1 for the most distant actions.
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
      policy: Name of a registered policy.
      options: Keyword arguments of the policy.
    """
    self._policy = base.make(policy, **(options or {}))
    controls = self.action_set.table(avatars.ACTIONS)
    distances = np.linalg.norm(controls[:, np.newaxis] - controls, axis=-1)
    self._values = 1.0 - 2.0 * distances / distances.max()

  @property
  def followed(self) -> base.Reader:
    return self._policy

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    action, state = self._policy.step(observation, episode_start, key, state)
    return self._values[action], state


@base.VALUE_FUNCTIONS.add(base.SOLVER_APPROVAL)
def solver_approval(
    policy: Annotated[str, option_types.NameIn(base.POLICIES)] = base.SOLVER,
    options: Annotated[
        Mapping[str, Any] | None,
        option_types.OptionsOf(base.POLICIES, 'policy'),
    ] = None,
) -> PolicyApproval:
  """Returns the function that approves the actions of a world's solver.

  Args:
    policy: Name of the solver; a design for any world leaves it out.
    options: Keyword arguments of the solver.
  """
  return PolicyApproval(policy, options)

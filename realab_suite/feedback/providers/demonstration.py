"""Demonstrations: the actions of a policy as feedback (paper, section 3.4)."""

import functools
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.feedback.providers import base


@base.PROVIDERS.add('demonstration')
@final
class Demonstration(policies.Follower, base.Provider):
  """Provider that writes the action of a policy for the agent's observation.

  The value is the index of the action.

  Attributes:
    policy: Name of a registered policy.
    options: Keyword arguments of the policy.
  """

  kind: Literal['demonstration'] = 'demonstration'
  writes: base.OneName
  policy: Annotated[str, option_types.NameIn(policies.POLICIES)]
  options: Annotated[
      dict[str, Any], option_types.OptionsOf(policies.POLICIES, 'policy')
  ] = pydantic.Field(default_factory=dict)

  @property
  def action_writes(self) -> tuple[str, ...]:
    return self.writes

  @functools.cached_property
  def followed(self) -> policies.Policy:
    """Policy that chooses the demonstrated actions."""
    return policies.make(self.policy, **self.options)

  def check(self, design: Any) -> None:
    policies.check_action_set(self.action_set, design, self.kind)

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    del readings
    action, state = self.followed.step(observation, episode_start, key, state)
    return {self.writes[0]: np.asarray(action, float)}, state

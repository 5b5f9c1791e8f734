"""Trusted policies: scripted policies that act in some worlds of a learner.

A policy gets what an agent gets. Whoever trusts it declares so in the design;
what it earns is not known to the learner other than by readings.
"""

from collections.abc import Collection
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite import policies
from realab_suite.config import option_types
from realab_suite.config import validation
from realab_suite.lab.agents import action_encoding
from realab_suite.lab.agents import base
from realab_suite.policies import base as policies_base
from realab_suite.policies import simple

_Share = Annotated[float, pydantic.Field(gt=0, lt=1)]


@final
class TrustedPolicy(validation.Model):
  """A policy, and the worlds of training in which it acts for the learner.

  Attributes:
    policy: Name of a registered policy.
    options: Keyword arguments of the policy.
    random: Share of its steps in which an action is drawn uniformly instead.
    worlds: Share of the worlds in which it acts, rounded up: the first ones.
    clone_steps: Number of control steps, summed over worlds, in which the
      learner clones it at first, and learns nothing else.
  """

  policy: Annotated[str, option_types.NameIn(policies_base.POLICIES)]
  options: Annotated[
      dict[str, Any],
      option_types.OptionsOf(policies_base.POLICIES, 'policy'),
  ] = pydantic.Field(default_factory=dict)
  random: Annotated[float, pydantic.Field(ge=0, le=1)] = 0.0
  worlds: _Share = 0.0625
  clone_steps: Annotated[int, pydantic.Field(ge=0, le=10**9)] = 0

  def make(
      self,
      controls: action_encoding.Controls,
      num_envs: int,
      observed: Collection[str],
      owner: str = 'learner.defence',
  ) -> 'TrustedActor':
    """Returns the policy, ready to act.

    Args:
      controls: Encoder of the learner's actions.
      num_envs: Number of worlds of the learner.
      observed: Keys of observations.
      owner: Location of the option that trusts it, for messages.

    Raises:
      SpecError: If the policy has other actions than the learner, reads other
        senses, or acts in all worlds.
    """
    policy = policies.make(self.policy, **self.options)
    where = f'{owner}.trusted.policy {self.policy!r}'
    action_set = controls.action_set
    rule = 'vectors' if action_set is None else action_set.key
    if action_set is not None:
      policy = policy.in_action_set(action_set)
    if action_set is None or policy.action_set.key != action_set.key:
      raise errors.SpecError(
          f'{where}: has the actions of {policy.action_set.key}; must be'
          f' those of the learner, {rule}'
      )
    needed = (*policy.required_senses, *policy.privileged_senses)
    senses = [name.removeprefix('senses/') for name in observed]
    policies.check_senses(where, needed, senses, 'observed')
    # In floating point, 0.07 * 100 is more than 7.
    number = max(1, int(np.ceil(np.round(self.worlds * num_envs, 6))))
    if number == num_envs:
      raise errors.SpecError(
          f'{owner}.trusted.worlds: {self.worlds:g}, all of {num_envs}'
          ' worlds; must be a smaller share'
      )
    if self.random:
      policy = simple.Distracted(policy, self.random)
    return TrustedActor(policy, np.arange(num_envs) < number)


@final
class TrustedActor:
  """A trusted policy, acting in the first worlds of a learner.

  Attributes:
    acts: Worlds in which it acts, `(worlds,)` bool.
  """

  def __init__(self, policy: policies_base.Policy, acts: np.ndarray) -> None:
    self._policy = policy
    self.acts = acts
    self._state = policy.initial_state((int(acts.sum()),))

  def steer(
      self, choice: base.Choice, time_step: base.TimeStep, key: np.ndarray
  ) -> base.Choice:
    """Returns a choice with its actions in its worlds; see `base.Wrapper`."""
    is_first = np.asarray(time_step.step_type)[self.acts] == base.FIRST
    view = {n: value[self.acts] for n, value in time_step.observation.items()}
    words = np.random.SeedSequence([int(word) for word in key])
    seeds = words.spawn(len(is_first))
    keys = np.stack([seed.generate_state(2, np.uint64) for seed in seeds])
    actions, self._state = self._policy.step(view, is_first, keys, self._state)
    action = choice['action'].copy()
    action[self.acts] = actions
    return {**choice, 'action': action}

  def state(self) -> Any:
    """Returns the state of the policy, as plain data."""
    return self._state

  def set_state(self, state: Any) -> None:
    """Continues from a state that `state` returned."""
    self._state = state

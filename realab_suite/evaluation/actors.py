"""Actors: policies, fitted to the action spec of an environment."""

from collections.abc import Callable
from typing import Any, Protocol, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.engine import seeding
from realab_suite.feedback import action_sets
from realab_suite.feedback import policies
from realab_suite.feedback import random_keys
from realab_suite.feedback import specs

# What dm_control's viewer calls a policy, and what an agent of yours may be.
PlainPolicy = Callable[[dm_env.TimeStep], Any]

TAKEN_ACTION = 'taken_action'
INDEPENDENT_ACTION = 'independent_action'
_QUERY_POLICIES = (TAKEN_ACTION, INDEPENDENT_ACTION)


class Actor(Protocol):
  """What runs in an environment: it is told of episodes, and it acts."""

  def begin(self, episode: int) -> None:
    """An episode begins."""

  def act(self, time_step: dm_env.TimeStep) -> Any:
    """Returns an action that fits the environment's `action_spec`."""


@final
class PlainActor:
  """An actor that calls a function of the time step."""

  def __init__(self, policy: PlainPolicy) -> None:
    self._policy = policy

  def begin(self, episode: int) -> None:
    """Does nothing: whatever `policy` remembers is its own business."""

  def act(self, time_step: dm_env.TimeStep) -> Any:
    return self._policy(time_step)


@final
class PolicyActor:
  """An actor that runs one of this package's policies.

  A policy names actions by index. Where the environment takes vectors, the
  index becomes one; where the design has query registers, each is asked about
  the action taken, or about one drawn independently, as the design's learner
  says in `query_policy`.
  """

  def __init__(
      self, policy: policies.Policy, env: environment.Environment
  ) -> None:
    """Fits a policy to an environment.

    Raises:
      SpecError: If the environment's actions are not those of the policy.
    """
    self._policy = policy
    self._seed, self._world = env.seed, env.world
    design = env.mechanism.design
    self._queries = [register.value_spec for register in env.mechanism.queries]
    self._query_policy = query_policy(design)
    self._table = action_table(
        policy, design, env.action_spec().name, len(self._queries)
    )
    self.begin(0)

  def begin(self, episode: int) -> None:
    """Forgets, and takes up the random stream of an episode."""
    self._key = seeding.episode_key(self._seed, self._world, episode, 'policy')
    self._query_key = seeding.episode_key(
        self._seed, self._world, episode, 'query'
    )
    self._state = self._policy.initial_state(())
    self._step = 0

  def act(self, time_step: dm_env.TimeStep) -> Any:
    index, self._state = self._policy.step(
        time_step.observation,
        np.asarray(self._step == 0),
        seeding.step_key(self._key, self._step),
        self._state,
    )
    action: Any = np.int32(index)
    if self._table is not None:
      action = self._table[int(index)]
    if self._queries:
      action = np.concatenate([self._ask(int(index)), np.atleast_1d(action)])
    self._step += 1
    return action

  def _ask(self, taken: int) -> np.ndarray:
    """Returns what goes into the query registers."""
    asked = taken
    if self._query_policy == INDEPENDENT_ACTION:
      key = seeding.step_key(self._query_key, self._step)
      asked = int(random_keys.uniform(key) * len(self._policy.action_set))
    return np.array(
        [np.clip(asked, spec.minimum, spec.maximum) for spec in self._queries]
    )


def query_policy(design: specs.DesignSpec) -> str:
  """Returns what a design's agent asks about: `TAKEN_ACTION` or another one.

  Raises:
    SpecError: If it asks about something else.
  """
  extras = (design.learner.model_extra or {}) if design.learner else {}
  asks_for: Any = extras.get('query_policy', TAKEN_ACTION)
  if asks_for not in _QUERY_POLICIES:
    raise errors.SpecError(
        f'design {design.name!r}: learner.query_policy: {asks_for!r}; allowed'
        f' are {list(_QUERY_POLICIES)}'
    )
  return str(asks_for)


def action_table(
    policy: policies.Policy,
    design: specs.DesignSpec,
    names: str | None,
    num_queries: int,
) -> np.ndarray | None:
  """Returns the vector of every action; `None` if agents act by index.

  Args:
    policy: Whose actions.
    design: The design of the environment.
    names: The name of the environment's action spec.
    num_queries: How many elements of an action are queries.

  Raises:
    SpecError: If the environment's actions are not those of the policy.
  """
  ours = policy.action_set
  if design.action_set is None:
    elements = (names or '').split('\t')[num_queries:]
    return ours.table(tuple(name.rpartition('/')[2] for name in elements))
  wanted = action_sets.get(design.action_set.name, design.action_set.version)
  if ours != wanted:
    raise errors.SpecError(
        f'the policy acts by {ours.name} v{ours.version}, the design by'
        f' {design.action_set.name} v{design.action_set.version}'
    )
  return None


def make(
    policy: policies.Policy | PlainPolicy, env: environment.Environment
) -> Actor:
  """Returns an actor for a policy of either kind.

  Raises:
    SpecError: If it is no policy, or its actions are not the environment's.
  """
  if isinstance(policy, policies.Policy):
    return PolicyActor(policy, env)
  if not callable(policy):
    raise errors.SpecError(
        f'policy: {policy!r:.80}; allowed are a policy, as policies.make'
        ' returns it, and a function from a time step to an action'
    )
  return PlainActor(policy)

"""Actors: policies, fitted to the action spec of an environment."""

from collections.abc import Callable
from typing import Any, Protocol, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.engine import seeding
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.policies import random_keys

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
  index becomes one. Query registers get the index of the action taken, or of
  one drawn independently, as the design's learner says in `query_policy`.
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
    self._queries = Queries(env.mechanism, len(policy.action_set))
    self._query_policy = query_policy(design)
    self._dtype = env.action_spec().dtype
    self._table = action_table(
        policy, design, env.action_spec().name, len(env.mechanism.queries)
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
    if self._queries.number:
      asked = self._queries.values(np.asarray(self._asked(int(index))))
      action = np.append(asked, action).astype(self._dtype)
    self._step += 1
    return action

  def _asked(self, taken: int) -> int:
    """Returns the index of the action to ask about."""
    if self._query_policy == TAKEN_ACTION:
      return taken
    key = seeding.step_key(self._query_key, self._step)
    return int(random_keys.uniform(key) * len(self._policy.action_set))


@final
class Queries:
  """Values for query registers that ask about an action.

  A register gets the index of the action. One that cannot hold every index, and
  whose providers do not take it for an index, gets the value nearest to 0.
  """

  def __init__(
      self,
      mechanism: mechanisms.FeedbackMechanism,
      num_actions: int,
  ) -> None:
    """Makes the queries of a mechanism.

    Args:
      mechanism: The registers.
      num_actions: Number of actions that may be asked about.

    Raises:
      SpecError: If a query register that holds indices cannot hold them all.
    """
    indices = mechanism.design.integer_queries()
    self._holds_index = []
    self._others = []
    for register in mechanism.queries:
      low, high = register.value_range
      holds_index = low <= 0 and num_actions - 1 <= high
      if register.name in indices and not holds_index:
        raise errors.SpecError(
            f'design {mechanism.design.name!r}:'
            f' registers.{register.name}.range: [{low:g}, {high:g}]'
            f' leaves out some of the actions 0 to {num_actions - 1}'
        )
      self._holds_index.append(holds_index)
      self._others.append(min(max(0.0, low), high))

  @property
  def number(self) -> int:
    """Number of query registers."""
    return len(self._others)

  def values(self, asked: np.ndarray) -> np.ndarray:
    """Returns values for the query registers, `(..., queries)`.

    Args:
      asked: Index of the action to ask about, `(...)`.
    """
    return np.where(self._holds_index, asked[..., np.newaxis], self._others)


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

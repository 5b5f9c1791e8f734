"""Actors, which adapt policies to the action spec of an environment.

Actors for batches are in `batch_actors`.
"""

import abc
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol, final

import dm_env
import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.engine import seeding
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs
from realab_suite.policies import random_keys

# A function from a time step to an action, as in dm_control's viewer.
PlainPolicy = Callable[[dm_env.TimeStep], Any]

TAKEN_ACTION = 'taken_action'
INDEPENDENT_ACTION = 'independent_action'
_SENSES = 'senses/'
_QUERY_POLICIES = (TAKEN_ACTION, INDEPENDENT_ACTION)


class Actor(Protocol):
  """Chooses actions in one environment, episode by episode."""

  def begin(self, episode: int) -> None:
    """Prepares for a new episode.

    Args:
      episode: Number of the episode, from 0.
    """

  def act(self, time_step: dm_env.TimeStep) -> Any:
    """Returns an action that fits the environment's `action_spec`."""


@final
class PlainActor:
  """An actor that calls a function of the time step."""

  def __init__(self, policy: PlainPolicy) -> None:
    self._policy = policy

  def begin(self, episode: int) -> None:
    """Does nothing; the function manages its own state, if it has any."""

  def act(self, time_step: dm_env.TimeStep) -> Any:
    return self._policy(time_step)


class PolicyRunner(abc.ABC):  # noqa: B024 - A subclass begins episodes.
  """Base class of actors that run one of this package's policies.

  Policies return action indices. Where the environment has another action set,
  the actor converts the index to that of the same action, and where it takes
  vectors, to a vector. Query registers get the index of the action taken, or of
  one drawn independently.
  """

  def __init__(
      self,
      policy: policies.Policy,
      env: Any,
      queries: Collection[str] | None = None,
  ) -> None:
    """Prepares an actor; a subclass calls `_begin`.

    Args:
      policy: The policy.
      env: Environment with one world or a batch.
      queries: Query registers that hold the action taken; the others hold
        independent actions. `None` for the query policy of the design's
        learner.

    Raises:
      SpecError: If the action sets of the policy and the environment differ, or
        if the policy needs other senses.
    """
    self._privileged = PrivilegedSenses(policy, env)
    self._policy = policy = policy.in_action_set(env.action_set)
    takes_controls = env.mechanism.design.action_set is None
    action_set = policy.action_set if takes_controls else env.action_set
    self._num_actions = len(action_set)
    self._indices = policy.action_set.translation(action_set)
    self._queries = Queries(env.mechanism, self._num_actions, queries)
    self._dtype = env.action_spec().dtype
    self._table = None
    if takes_controls:
      names = (env.action_spec().name or '').split('\t')
      elements = names[self._queries.number :]
      self._table = action_set.table(
          tuple(name.rpartition('/')[2] for name in elements)
      )

  def _begin(self, keys: np.ndarray, query_keys: np.ndarray) -> None:
    """Begins an episode in each world, with random keys, `(..., 2)`."""
    self._keys, self._query_keys = keys, query_keys
    self._state = self._policy.initial_state(keys.shape[:-1])
    self._step = 0

  def act(self, time_step: Any) -> Any:
    """Returns actions, `(..., *action_spec.shape)`."""
    choices, self._state = self._policy.step(
        self._privileged.added_to(time_step.observation),
        np.full(self._keys.shape[:-1], self._step == 0),
        random_keys.of_step(self._keys, self._step),
        self._state,
    )
    indices = self._indices[choices]
    actions = indices if self._table is None else self._table[indices]
    if self._queries.number:
      query_values = self._queries.values(indices, self._independent())
      rest = np.reshape(actions, (*indices.shape, -1))
      actions = np.concatenate([query_values, rest], axis=-1)
      actions = actions.astype(self._dtype)
    self._step += 1
    return actions

  def _independent(self) -> np.ndarray:
    """Returns indices of actions drawn independently, `(...)`."""
    keys = random_keys.of_step(self._query_keys, self._step)
    drawn = random_keys.uniform(keys) * self._num_actions
    return np.asarray(drawn, int)


@final
class PolicyActor(PolicyRunner):
  """An actor that runs one of this package's policies in one world."""

  def __init__(
      self, policy: policies.Policy, env: environment.Environment
  ) -> None:
    """Makes an actor; see `PolicyRunner`."""
    super().__init__(policy, env)
    self._seed, self._world = env.seed, env.world
    self.begin(0)

  def begin(self, episode: int) -> None:
    """Resets the policy and selects the random streams of an episode."""
    self._begin(
        *(
            seeding.episode_key(self._seed, self._world, episode, name)
            for name in ('policy', 'query')
        )
    )


@final
class PrivilegedSenses:
  """Senses of a policy that are no part of the agent's observations."""

  def __init__(self, policy: policies.Policy, env: Any) -> None:
    """Finds the senses of a policy.

    Args:
      policy: The policy.
      env: Environment with one world or a batch.

    Raises:
      SpecError: If observations lack a sense that the policy requires, or if
        the task does not offer a privileged one.
    """
    self._env = env
    name = f'policy {type(policy).__name__}'
    selected = [
        key.removeprefix(_SENSES)
        for key in env.observation_spec()
        if key.startswith(_SENSES)
    ]
    policies.check_senses(name, policy.required_senses, selected)
    wanted = policy.privileged_senses
    offered = getattr(env.task, 'privileged_senses', {})  # Not of foreign ones.
    if missing := [sense for sense in wanted if sense not in offered]:
      raise errors.SpecError(
          f'{name} reads {missing} from the state of the world; this task'
          f' offers {sorted(offered)}'
      )
    self._functions = {f'privileged/{one}': offered[one] for one in wanted}

  def added_to(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns an observation of the current step with these senses."""
    if not self._functions:
      return observation
    physics = self._env.physics
    privileged = {
        key: np.array(function(physics))
        for key, function in self._functions.items()
    }
    return {**observation, **privileged}


@final
class Queries:
  """Computes values of query registers from indices of actions.

  A register that can hold every index gets the index. Another one gets the
  value in its range that is nearest to 0, provided that no provider reads it as
  an index.
  """

  def __init__(
      self,
      mechanism: mechanisms.FeedbackMechanism,
      num_actions: int,
      taken: Collection[str] | None,
  ) -> None:
    """Prepares the query registers of a mechanism.

    Args:
      mechanism: Mechanism that owns the query registers.
      num_actions: Number of actions that a query may refer to.
      taken: As `queries` of `PolicyRunner`.

    Raises:
      SpecError: If a provider reads a register as an index, and the register
        cannot hold every index.
    """
    design = mechanism.design
    if taken is None:
      is_taken = query_policy(design) == TAKEN_ACTION
      taken = design.names('query') if is_taken else ()
    self._holds_taken = [one.name in taken for one in mechanism.queries]
    indices = design.integer_queries()
    self._holds_index = []
    self._others = []
    for register in mechanism.queries:
      low, high = register.value_range
      holds_index = low <= 0 and num_actions - 1 <= high
      if register.name in indices and not holds_index:
        raise errors.SpecError(
            f'design {design.name!r}:'
            f' registers.{register.name}.range: [{low:g}, {high:g}]'
            f' does not contain all actions from 0 to {num_actions - 1}'
        )
      self._holds_index.append(holds_index)
      self._others.append(min(max(0.0, low), high))

  @property
  def number(self) -> int:
    """Number of query registers."""
    return len(self._others)

  def values(self, taken: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Returns values for the query registers, `(..., queries)`.

    Args:
      taken: Indices of the actions taken, `(...)`.
      independent: Indices of independent actions, `(...)`.
    """
    indices = np.where(
        self._holds_taken, taken[..., np.newaxis], independent[..., np.newaxis]
    )
    return np.where(self._holds_index, indices, self._others)


def query_policy(design: specs.DesignSpec) -> str:
  """Returns the query policy of a design's learner.

  It is `TAKEN_ACTION`, also where the learner does not specify one, or
  `INDEPENDENT_ACTION`.

  Raises:
    SpecError: If the learner specifies another query policy.
  """
  extras = (design.learner.model_extra or {}) if design.learner else {}
  name: Any = extras.get('query_policy', TAKEN_ACTION)
  if name not in _QUERY_POLICIES:
    raise errors.SpecError(
        f'design {design.name!r}: learner.query_policy: {name!r}; must'
        f' be one of {list(_QUERY_POLICIES)}'
    )
  return str(name)


def make(
    policy: policies.Policy | PlainPolicy, env: environment.Environment
) -> Actor:
  """Returns an actor for a policy or a function of time steps.

  Args:
    policy: A policy, or a function from a time step to an action.
    env: Environment to act in.

  Raises:
    SpecError: If `policy` is neither, or its action set differs from the
      environment's.
  """
  if isinstance(policy, policies.Policy):
    return PolicyActor(policy, env)
  if not callable(policy):
    raise errors.SpecError(
        f'policy: {policy!r:.80}; must be a policy from policies.make or a'
        ' function from a time step to an action'
    )
  return PlainActor(policy)

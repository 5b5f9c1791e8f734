"""Actors for batches, which adapt policies to a batch's action spec.

Actors for a single environment are in `actors`.
"""

from collections.abc import Collection, Sequence
from typing import Any, Protocol, final

import numpy as np

from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import seeding
from realab_suite.evaluation import actors
from realab_suite.policies import random_keys


class BatchActor(Protocol):
  """Chooses actions in a batch of worlds, for one episode in each."""

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> Any:
    """Returns actions, `(worlds, *action_spec.shape)`."""


@final
class BatchPolicyActor:
  """Runs a policy for one episode in every world of a batch.

  In each world it chooses the same actions as `actors.PolicyActor` does in that
  world alone.
  """

  def __init__(
      self,
      policy: policies.Policy,
      batch: batch_environment.BatchEnvironment,
      seed: int,
      episodes: Sequence[tuple[int, int]] | None = None,
      queries: Collection[str] | None = None,
  ) -> None:
    """Makes an actor.

    Args:
      policy: The policy.
      batch: The worlds, before the episodes.
      seed: Seed of the batch.
      episodes: Numbers of the world and of the episode of each row that it acts
        in; `None` for the first episode of every world.
      queries: Query registers that hold the action taken; the others hold
        independent actions. `None` for the query policy of the design.

    Raises:
      SpecError: If the action sets of the policy and the batch differ, or if
        the policy needs other senses.
    """
    self._privileged = actors.PrivilegedSenses(policy, batch)
    self._policy = policy = policy.in_action_set(batch.action_set)
    mechanism = batch.mechanism
    design = mechanism.design
    self._action_set, self._indices = actors.translation(policy, design)
    self._queries = actors.Queries(mechanism, len(self._action_set))
    self._dtype = batch.action_spec().dtype
    if queries is None:
      is_taken = actors.query_policy(design) == actors.TAKEN_ACTION
      queries = design.names('query') if is_taken else ()
    self._holds_taken = [one.name in queries for one in mechanism.queries]
    self._table = None
    if design.action_set is None:
      names, number = batch.action_spec().name, self._queries.number
      self._table = actors.action_table(self._action_set, names, number)
    if episodes is None:
      episodes = [(world, 0) for world in range(batch.num_envs)]
    self._keys, self._query_keys = (
        np.stack([seeding.episode_key(seed, *one, name) for one in episodes])
        for name in ('policy', 'query')
    )
    self._state = policy.initial_state((len(episodes),))
    self._step = 0

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    """Returns actions, `(worlds, *action_spec.shape)`."""
    chosen, self._state = self._policy.step(
        self._privileged.added_to(time_step.observation),
        np.full(len(self._keys), self._step == 0),
        random_keys.of_step(self._keys, self._step),
        self._state,
    )
    indices = self._indices[chosen]
    actions = indices
    if self._table is not None:
      actions = self._table[indices]
    if self._queries.number:
      rest = actions.reshape(len(actions), -1)
      query_values = np.where(
          self._holds_taken,
          self._queries.values(indices),
          self._queries.values(self._independent()),
      )
      actions = np.concatenate([query_values, rest], axis=1).astype(self._dtype)
    self._step += 1
    return actions

  def _independent(self) -> np.ndarray:
    """Returns indices of actions drawn independently, `(worlds,)`."""
    keys = random_keys.of_step(self._query_keys, self._step)
    drawn = random_keys.uniform(keys) * len(self._action_set)
    return drawn.astype(int)

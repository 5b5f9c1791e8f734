"""Actors for batches, which adapt policies to a batch's action spec.

Actors for a single environment are in `actors`.
"""

from collections.abc import Collection
from typing import Any, Protocol, final

import numpy as np

from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import seeding
from realab_suite.evaluation import actors


class BatchActor(Protocol):
  """Chooses actions in a batch of worlds, for one episode in each."""

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> Any:
    """Returns actions, `(worlds, *action_spec.shape)`."""


@final
class BatchPolicyActor(actors.PolicyRunner):
  """Runs a policy for one episode in every world of a batch.

  In each world it chooses the same actions as `actors.PolicyActor` does in that
  world alone.
  """

  def __init__(
      self,
      policy: policies.Policy,
      batch: batch_environment.BatchEnvironment,
      seed: int,
      queries: Collection[str] | None = None,
  ) -> None:
    """Makes an actor.

    Args:
      policy: The policy.
      batch: The worlds, before their first episode.
      seed: Seed of the batch.
      queries: As in `PolicyRunner`.

    Raises:
      SpecError: As in `PolicyRunner`.
    """
    super().__init__(policy, batch, queries)
    self._begin(
        *(
            np.stack(
                [
                    seeding.episode_key(seed, world, 0, name)
                    for world in range(batch.num_envs)
                ]
            )
            for name in ('policy', 'query')
        )
    )

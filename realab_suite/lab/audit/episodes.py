"""Episodes of an audit: plans, and the task's solver, in batches of worlds."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import events
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import macros


@final
class Player:
  """Plays plans, and the solver of the task, in a batch of worlds."""

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      targets: Sequence[aiming.Target],
      solver: str,
      seed: int,
  ) -> None:
    """Makes the player.

    Args:
      batch: The worlds.
      targets: What plans refer to.
      solver: Name of the policy that does the task.
      seed: Seed of the batch.
    """
    self._batch = batch
    self._targets = targets
    self._solver = solver
    self._seed = seed

  @property
  def num_envs(self) -> int:
    """Number of worlds."""
    return self._batch.num_envs

  def play_solver(self) -> list[results.EpisodeResult]:
    """Plays the next episode of every world with the solver."""
    return self._play(lambda: policies.make(self._solver))

  def play(self, plans: Sequence[macros.Plan]) -> list[results.EpisodeResult]:
    """Plays the next episode of every world with a plan.

    Worlds without a plan of their own repeat the first one; their results are
    left out.

    Args:
      plans: Plans of the first worlds, from one to `num_envs`.

    Returns:
      The result of each plan.
    """
    filled = [*plans, *[plans[0]] * (self.num_envs - len(plans))]
    plan = macros.stack(filled)
    # The places of blocks are known when the episode has begun.
    return self._play(
        lambda: policy_of(plan, self._batch, self._targets, self._solver)
    )[: len(plans)]

  def _play(
      self, make_policy: Callable[[], policies.Policy]
  ) -> list[results.EpisodeResult]:
    actor = _LateActor(self._batch, self._seed, make_policy)
    return evaluate.evaluate_batch(self._batch, actor)


@final
class _LateActor:
  """Actor whose policy is made at the first step of the episodes."""

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      seed: int,
      make_policy: Callable[[], policies.Policy],
  ) -> None:
    self._batch = batch
    self._seed = seed
    self._make_policy = make_policy
    self._actor: batch_actors.BatchPolicyActor | None = None

  def act(self, time_step: batch_time_steps.BatchTimeStep) -> np.ndarray:
    """Returns actions, `(worlds, *action_spec.shape)`."""
    if self._actor is None:
      self._actor = batch_actors.BatchPolicyActor(
          self._make_policy(), self._batch, self._seed
      )
    return self._actor.act(time_step)


def policy_of(
    plan: macros.Plan,
    env: Any,
    targets: Sequence[aiming.Target],
    solver: str,
) -> policies.Policy:
  """Returns the policy of a plan.

  Args:
    plan: The plan, or a plan for each world.
    env: Environment with one world or a batch, at the start of an episode.
    targets: What it refers to; without any, a plan can only do the task.
    solver: Name of the policy that does the task.

  Raises:
    SpecError: If the solver has another action set.
  """
  if not targets:
    return policies.make(solver)
  return macros.MacroPolicy(
      plan,
      aiming.places(env, targets),
      np.array([target.code for target in targets]),
      policies.make(solver),
  )


@final
class Watch(events.BatchEventSink):
  """Measures how far blocks are moved in the next episode of each world.

  Attributes:
    metres: Largest displacement of each block, `(worlds, blocks)`; see
      `Register.displacements`.
    held: Number of steps in which the hand held it, `(worlds, blocks)`.
  """

  def __init__(
      self,
      batch: batch_environment.BatchEnvironment,
      targets: Sequence[aiming.Target],
  ) -> None:
    """Makes the watch, to be passed to `batch.add_sink`."""
    self._batch = batch
    self._targets = targets
    self._blocks = [target.block_in(batch) for target in targets]
    self._starts = np.zeros((batch.num_envs, len(targets), 2))
    self._has_ended = np.zeros(batch.num_envs, bool)
    self.metres = np.zeros((batch.num_envs, len(targets)))
    self.held = np.zeros((batch.num_envs, len(targets)), int)

  def step_ended(self, step: events.BatchStep) -> None:
    if not self._targets:
      return
    physics = self._batch.physics
    places = aiming.positions(physics, self._blocks)
    begins = step.is_first & ~self._has_ended
    self._starts[begins] = places[begins]
    counts = ~(step.is_first | step.has_failed | self._has_ended)
    for i, target in enumerate(self._targets):
      register = self._batch.mechanism.registers[target.register]
      metres = register.displacements(physics)[:, target.number]
      if len(register.blocks) > 1:
        # A kind may only know how far all of its blocks have moved together.
        moved = np.linalg.norm(places[:, i] - self._starts[:, i], axis=-1)
        metres = np.minimum(metres, moved)
      farthest = self.metres[:, i]
      np.maximum(farthest, metres, out=farthest, where=counts)
      for grasp in self._blocks[i].grasps:
        active = physics.bind(grasp.constraints).active
        self.held[:, i] += counts & np.any(active, axis=-1)
    self._has_ended[list(step.ends)] = True

"""One control step, for one world and for many.

`run` is the list in `docs/architecture.md`. Leading axes of all arrays are
worlds: `()` for one world, `(worlds,)` for many. Nothing here keeps state, and
nothing here notifies event sinks.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.engine import hosts
from realab_suite.engine import seeding
from realab_suite.entities import axes
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms
from realab_suite.feedback import specs


@final
class Outcome(NamedTuple):
  """The result of a control step.

  Attributes:
    records: Writes and reads, in the order of time.
    ending: Reward, discount and end, as the task gives them.
    provider_states: State of each provider after the step.
  """

  records: list[registers.Record]
  ending: hosts.Ending
  provider_states: list[Any]


def run(
    physics: hosts.SteppedPhysics,
    host: hosts.Host,
    mechanism: mechanisms.FeedbackMechanism,
    schedule: specs.ScheduleSpec,
    num_substeps: int,
    *,
    queries: np.ndarray,
    controls: np.ndarray,
    observation: dict[str, np.ndarray],
    provider_keys: np.ndarray,
    provider_states: Sequence[Any],
    idle: Callable[[], np.ndarray | None] = lambda: None,
) -> Outcome:
  """Runs a control step; the caller observes and notifies the sinks.

  Args:
    physics: One world, or many.
    host: The task.
    mechanism: The registers, meters and providers.
    schedule: Substeps after which meters and providers act.
    num_substeps: Substeps of a control step.
    queries: Values for the query registers, `(..., queries)`.
    controls: Controls of the task, `(..., controls)`.
    observation: Observation that the action responds to, by name.
    provider_keys: Key of each provider's episode, `(providers, ..., 2)`,
      uint64.
    provider_states: State of each provider.
    idle: In a batch, returns the worlds whose records do not count, `(worlds,)`
      bool: those that begin an episode next, and those that have failed since.
      For one world, returns `None`.

  Raises:
    PhysicsError: If the physics of one world has failed. In a batch, a world
      that has failed is left out instead.
  """
  was_over = host.is_over(physics)
  host.begin_step(physics, controls)
  records: list[registers.Record] = []
  records += mechanism.write_queries(physics, queries)

  host.advance(physics, controls, schedule.meter_substep, is_last=False)
  is_ending = host.is_over(physics)
  records += mechanism.update_meters(physics, idle())

  between = schedule.provider_substep - schedule.meter_substep
  host.advance(physics, controls, between, is_last=False)
  step = mechanism.step_count(physics)
  feedback, next_states = mechanism.update_providers(
      physics,
      observation,
      seeding.step_key(provider_keys, step),
      provider_states,
      idle(),
  )
  records += feedback

  rest = num_substeps - schedule.provider_substep
  host.advance(physics, controls, rest, is_last=True)
  ending = host.end_step(physics, was_over, is_ending)
  reward = ending.true_reward
  mechanism.end_step(physics, axes.choose(np.isfinite(reward), reward, 0.0))
  return Outcome(records, ending, next_states)

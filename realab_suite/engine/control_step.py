"""The control step of tasks of this package, for one world and for a batch.

`run` implements the list in `docs/architecture.md`. The leading axes of all
arrays are worlds: `()` for one world, `(worlds,)` for a batch. This module does
not notify event sinks.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.engine import hosts
from realab_suite.entities import axes
from realab_suite.entities import registers
from realab_suite.feedback import phases as mechanism_phases
from realab_suite.feedback import specs


@final
class Outcome(NamedTuple):
  """The result of a control step.

  Attributes:
    records: Writes and reads, in order of time.
    ending: Reward, discount and end of the episode, as the task returns them.
    provider_states: State of each provider after the step.
    num_steps: Number of completed control steps of the episode, `(...)`.
  """

  records: list[registers.Record]
  ending: hosts.Ending
  provider_states: list[Any]
  num_steps: Any


def run(
    physics: hosts.SteppedPhysics,
    host: hosts.WorldHost,
    phases: mechanism_phases.Phases,
    schedule: specs.ScheduleSpec,
    num_substeps: int,
    *,
    queries: np.ndarray,
    controls: np.ndarray,
    observation: dict[str, np.ndarray],
    provider_keys: np.ndarray,
    provider_states: Sequence[Any],
    where: Callable[[], axes.Mask] | None = None,
) -> Outcome:
  """Runs a control step. The caller observes and notifies the sinks.

  Args:
    physics: Physics of one world or of a batch.
    host: Host of the task.
    phases: Phases of the mechanism.
    schedule: Substeps after which meters and providers act.
    num_substeps: Number of substeps in a control step.
    queries: Values for the query registers, `(..., queries)`.
    controls: Controls of the task, `(..., controls)`.
    observation: Observation that the action responds to, with what providers
      alone sense, by name.
    provider_keys: Random key of each provider in this episode, `(providers,
      ..., 2)` uint64.
    provider_states: State of each provider.
    where: Function that returns the worlds of a batch in which meters and
      providers write, `(worlds,)` bool: all except worlds that begin an episode
      after this step, and worlds that have failed; `None` for a single world.

  Raises:
    PhysicsError: If the physics of a single world has failed. In a batch, a
      world that has failed is skipped instead.
    FeedbackProviderError: If a provider failed.
    RegisterValueError: If a written value cannot be stored.
  """
  was_over = host.is_over(physics)
  host.begin_step(physics, controls)
  records: list[registers.Record] = []
  records += phases.write_queries(physics, queries)

  host.advance(physics, schedule.meter_substep, is_last=False)
  is_ending = host.is_over(physics)
  records += phases.update_meters(physics, where() if where else None)

  between = schedule.provider_substep - schedule.meter_substep
  host.advance(physics, between, is_last=False)
  feedback, next_states = phases.update_providers(
      physics,
      observation,
      provider_keys,
      provider_states,
      where() if where else None,
  )
  records += feedback

  rest = num_substeps - schedule.provider_substep
  host.advance(physics, rest, is_last=True)
  ending = host.end_step(physics, was_over, is_ending)
  num_steps = phases.end_step(physics, ending.true_reward)
  return Outcome(records, ending, next_states, num_steps)
